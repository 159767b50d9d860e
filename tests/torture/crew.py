"""The processes of one job as a supervisor keeps them: a scheduler, workers and the service; whatever dies is started
again, as systemd or compose would."""

import json
import os
import random
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil

ROOT = Path(__file__).parents[2]
VICTIMS = ("worker", "nanny", "scheduler", "service")
TRAINER = "trainer"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Crew:
    """Starts, watches and kills.

    Args:
        folder: for the store, logs and status.
        num_workers: worker processes.
        driver_options: further options of `tests/torture/driver.py`.
    """

    def __init__(self, folder: Path, num_workers: int, driver_options: list[str]) -> None:
        self.folder, self.store, self.status = folder, folder / "store", folder / "status"
        folder.mkdir(parents=True, exist_ok=True)
        port = free_port()
        self._address = f"tcp://127.0.0.1:{port}"
        python = [sys.executable, "-m"]
        self._commands = {"scheduler": [*python, "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port",
                                        str(port), "--no-dashboard", "--dashboard-address", "127.0.0.1:0"]}  # fmt: skip
        for index in range(num_workers):
            options = ["--scheduler", self._address, "--name", f"w{index}", "--train-threads", "1"]
            self._commands[f"nanny {index}"] = [*python, "service.cli", "worker", *options]
        self._commands["service"] = [*python, "tests.torture.driver", "--store", str(self.store), "--scheduler",
                                     self._address, "--status", str(self.status), *driver_options]  # fmt: skip
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self.restarts = self.failures = 0

    def __enter__(self) -> "Crew":
        for name in self._commands:
            self._start(name)
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._running.values():
            for child in _family(process.pid):
                child.kill()
        for process in self._running.values():
            process.wait()

    def _start(self, name: str) -> None:
        environment = os.environ | {
            "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "default", "LIGHTWELL_CHECKPOINT_SECONDS": "0.5",
            "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0", "DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": "60s",
        }  # fmt: skip
        with (self.folder / f"{name.replace(' ', '-')}.log").open("ab") as log:
            self._running[name] = subprocess.Popen(
                self._commands[name], cwd=ROOT, env=environment, stdout=log, stderr=log
            )

    def revive(self) -> bool:
        """Starts what died again; whether the job is complete."""
        for name, process in list(self._running.items()):
            code = process.poll()
            if code is None:
                continue
            if name == "service" and code == 0:
                return True
            if name == "service" and code > 0:
                self.failures += 1
            self.restarts += 1
            time.sleep(0.2)
            self._start(name)
        return False

    def kill(self, victim: str, rng: random.Random) -> bool:
        """Sends SIGKILL to one process of a kind; whether there was one."""
        if victim in ("worker", TRAINER):
            children = [child for name, process in self._running.items() if name.startswith("nanny")
                        for child in _family(process.pid)[1:] if _computes(child)]  # fmt: skip
            if not children:
                return False
            pid = _busiest(children) if victim == TRAINER else rng.choice(children).pid
        else:
            names = [name for name in self._running if name.startswith(victim)]
            pid = self._running[rng.choice(names)].pid
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            return False
        return True

    def events(self) -> list[dict[str, Any]]:
        """What the service wrote; a line that a kill cut short is left out."""
        found = []
        for line in self.status.read_text().splitlines() if self.status.exists() else []:
            try:
                found.append(json.loads(line))
            except ValueError:
                continue
        return found

    def stage(self) -> str:
        """First word of the stage that progressed last."""
        stages = [event["stage"] for event in self.events() if event["kind"] == "progress"]
        return stages[-1].split()[0] if stages else "start"


def _family(pid: int) -> list[psutil.Process]:
    try:
        process = psutil.Process(pid)
        return [process, *process.children(recursive=True)]
    except psutil.NoSuchProcess:
        return []


def _computes(process: psutil.Process) -> bool:
    """A worker process, not Python's resource tracker beside it."""
    try:
        return "spawn_main" in " ".join(process.cmdline())
    except psutil.Error:
        return False


def _busiest(processes: list[psutil.Process]) -> int:
    shares: dict[int, float] = {}
    for process in processes:
        try:
            shares[process.pid] = process.cpu_percent(0.1)
        except psutil.Error:
            continue
    return max(shares, key=lambda pid: shares[pid], default=processes[0].pid)
