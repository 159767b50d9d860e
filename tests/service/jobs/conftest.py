"""Job databases (SQLite, and PostgreSQL where a server can be started), a runner that computes nothing."""

import contextlib
import os
import shutil
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import create_engine, text

from service.job_runner import JobFailed, JobStopped
from service.jobs.database import Database
from service.jobs.table import JobTable, Submission
from service.unit_request import UnitTotals

POSTGRES_URL = "LIGHTWELL_TEST_POSTGRES"
"""A server to test with, as a URL whose user may create databases; else one is started from its binaries."""
POSTGRES_NEEDED = "LIGHTWELL_TEST_NEEDS_POSTGRES"
"""Set in CI: a missing server is an error there and not a skip."""


@pytest.fixture(scope="session")
def postgres_server() -> Iterator[str]:
    """URL of a PostgreSQL server's maintenance database."""
    given = os.environ.get(POSTGRES_URL)
    if given:
        yield given
        return
    folders = [*sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)]
    found = shutil.which("initdb") or next((str(f / "initdb") for f in folders if (f / "initdb").is_file()), None)
    try:
        if found is None:
            raise OSError("no initdb found")
        with contextlib.ExitStack() as stack:
            yield stack.enter_context(_started(Path(found).resolve().parent))
    except (OSError, subprocess.SubprocessError) as error:
        if os.environ.get(POSTGRES_NEEDED):
            raise
        pytest.skip(f"no PostgreSQL server could be started ({error}); set {POSTGRES_URL}")


@contextlib.contextmanager
def _started(binaries: Path) -> Iterator[str]:
    """A server on a free port; as root, under an unprivileged user, for it refuses to run as root."""
    user = {"user": "postgres", "group": "postgres", "extra_groups": []} if os.geteuid() == 0 else {}
    folder = Path(tempfile.mkdtemp(prefix="lightwell-pg-", dir="/tmp"))  # a socket's path must be short
    if user:
        shutil.chown(folder, "postgres", "postgres")
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    quiet: dict[str, Any] = {"check": True, "capture_output": True, "timeout": 60, "cwd": folder, **user}
    data, options = folder / "data", f"-F -p {port} -k {folder} -c listen_addresses=127.0.0.1"
    try:
        subprocess.run([binaries / "initdb", "-D", data, "-U", "tester", "-A", "trust", "--no-sync"], **quiet)
        start = [binaries / "pg_ctl", "-D", data, "-w", "-l", folder / "log", "-o", options, "start"]
        subprocess.run(start, **quiet | {"capture_output": False, "stdout": subprocess.DEVNULL})
        try:
            yield f"postgresql+psycopg://tester@127.0.0.1:{port}/postgres"
        finally:
            subprocess.run([binaries / "pg_ctl", "-D", data, "-m", "immediate", "stop"], **quiet)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="session")
def postgres_database(postgres_server: str) -> Iterator[str]:
    """URL of a database of this session's own."""
    name = f"lightwell_{os.getpid()}_{time.monotonic_ns()}"
    engine = create_engine(postgres_server, isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(text(f"CREATE DATABASE {name}"))
        yield f"{postgres_server.rpartition('/')[0]}/{name}"
        connection.execute(text(f"DROP DATABASE {name} WITH (FORCE)"))
    engine.dispose()


@pytest.fixture(params=["sqlite", "postgres"])
def database_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """An empty database of each kind."""
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'jobs.sqlite'}"
    url = request.getfixturevalue("postgres_database")
    engine = create_engine(url)
    with engine.begin() as connection:
        connection.execute(text("DROP SCHEMA public CASCADE; CREATE SCHEMA public"))
    engine.dispose()
    return url


@pytest.fixture
def database(database_url: str) -> Iterator[Database]:
    opened = Database(database_url)
    yield opened
    opened.close()


@pytest.fixture
def table(database: Database) -> JobTable:
    return JobTable(database)


@pytest.fixture
def sqlite_table(tmp_path: Path) -> Iterator[JobTable]:
    opened = Database(f"sqlite:///{tmp_path / 'jobs.sqlite'}")
    yield JobTable(opened)
    opened.close()


@pytest.fixture
def submission() -> Callable[..., Submission]:
    """Makes submissions; those of different names compute different units."""

    def make(name: str = "a", priority: int = 0) -> Submission:
        stages = ["bake", "render", "train", "evaluate"]
        request = {"scene": name, "preset": "tiny", "settings": {}, "stages": stages, "priority": priority}
        spec = {"scene": name, "settings": {}, "stages": stages}
        return Submission(request=request, spec=spec, request_digest=f"r{name}{priority}", spec_digest=f"s{name}",
                          priority=priority)  # fmt: skip

    return make


@dataclass
class FakeRunner:
    """Runs `num_steps` steps of `step_s` seconds; notes what it ran, in order, and how much at once."""

    num_steps: int = 3
    step_s: float = 0.0
    failure: BaseException | None = None
    started: list[str] = field(default_factory=list)
    ran: list[str] = field(default_factory=list)
    busy: int = 0
    most_busy: int = 0
    closed: bool = False
    may_end: threading.Event = field(default_factory=threading.Event)
    totals: UnitTotals = field(default_factory=UnitTotals)

    def __post_init__(self) -> None:
        self.may_end.set()

    def run(self, job_id: str, spec: Any, on_event: Any, should_stop: Any) -> dict[str, Any]:
        self.started.append(spec.scene)
        self.busy += 1
        self.most_busy = max(self.busy, self.most_busy)
        try:
            for step in range(self.num_steps):
                if self.failure is not None:
                    raise self.failure
                time.sleep(self.step_s)
                progress = {"stage": "bake", "done": step + 1.0, "total": float(self.num_steps), "eta_s": None}
                on_event({"kind": "progress", "note": "", **progress})
                self._check(should_stop)
            while not self.may_end.wait(0.01):
                self._check(should_stop)
        finally:
            self.busy -= 1
        self.ran.append(spec.scene)
        on_event({"kind": "preview", "png": b"\x89PNG fake"})
        return {"evaluation": None, "units": self.num_steps, "set_aside": []}

    def _check(self, should_stop: Any) -> None:
        stop = should_stop()
        if stop is not None:
            raise JobStopped(stop)

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def runner() -> FakeRunner:
    return FakeRunner()


@pytest.fixture
def job_failed() -> type[JobFailed]:
    return JobFailed


@pytest.fixture
def wait_until() -> Callable[..., None]:
    """Waits for a condition, 10 s at most."""

    def wait(condition: Callable[[], Any], what: str = "it") -> None:
        deadline_s = time.monotonic() + 10
        while not condition():
            assert time.monotonic() < deadline_s, f"{what} did not happen in 10 s"
            time.sleep(0.01)

    return wait
