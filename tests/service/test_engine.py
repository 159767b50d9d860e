"""The engine on worker processes, with stages that answer at once: failures, deaths, stops, sharing, recycling."""

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from service.engine import DaskRunner
from service.job_runner import JobFailed, JobStopped
from service.unit_task import Recycling
from tests.service.fake_stages import fake_execute, fake_spec, started
from workers.job_spec import JobSpec
from workers.thread_policy import ThreadPolicy


@pytest.fixture(scope="module")
def runner(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DaskRunner]:
    store = tmp_path_factory.mktemp("engine") / "store"
    with DaskRunner(str(store), num_workers=2, threads=ThreadPolicy(), executor=fake_execute) as runner:
        yield runner


class Watch:
    """Keeps a job's events; stops it when told to."""

    def __init__(self) -> None:
        self.events: list[dict[str, Any]] = []
        self.stop: Any = None

    def run(self, runner: DaskRunner, spec: JobSpec) -> dict[str, Any]:
        return runner.run("job", spec, self.events.append, lambda: self.stop)

    def run_until_stopped(self, runner: DaskRunner, spec: JobSpec) -> None:
        with pytest.raises(JobStopped):
            self.run(runner, spec)

    def of(self, kind: str) -> list[dict[str, Any]]:
        return [event for event in self.events if event["kind"] == kind]


def wait_for(condition: Callable[[], Any], seconds: float = 15.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "timed out"
        time.sleep(0.02)


def test_job_runs_every_unit_once_and_tells_its_progress(runner: DaskRunner, tmp_path: Path) -> None:
    watch, before = Watch(), runner.totals.units.total()
    result = watch.run(runner, fake_spec(tmp_path, digest="once"))
    assert runner.totals.units.total() - before == result["units"] and runner.totals.seconds["bake"] > 0
    assert result["evaluation"]["rows"] == [{"name": "ours", "psnr": None}]
    assert watch.of("report") == [{"kind": "report", "html": "<html>pictures</html>"}]
    assert result["set_aside"] == []
    assert result["units"] == result["planned_units"] == 1 + 1 + 1 + 6 + 20 + 1 + 4 + 1 + 1
    assert max(Counter(name for name, _, _ in started(tmp_path)).values()) == 1
    last = {event["stage"]: event for event in watch.of("progress")}
    assert all(event["done"] == event["total"] and event["eta_s"] == 0 for event in last.values())
    assert last["bake diffuse"]["total"] == 20
    assert watch.of("preview")[0]["png"].startswith(b"\x89PNG")


@pytest.mark.parametrize("chained", [False, True])
def test_job_run_again_computes_no_stored_unit(runner: DaskRunner, tmp_path: Path, chained: bool) -> None:
    spec = fake_spec(tmp_path, digest=f"again-{chained}", chained=chained)
    Watch().run(runner, spec)
    (tmp_path / "asked").unlink()
    watch = Watch()
    watch.run(runner, spec)
    assert {name.split()[0] for name, _, _ in started(tmp_path, "asked")} == {
        "census",
        "inventory",
        "train",
        "evaluate",
    }
    assert [event["done"] for event in watch.of("progress") if event["stage"] == "bake diffuse"] == [20]


def test_job_bakes_a_set_once_the_one_before_it_is_sealed(runner: DaskRunner, tmp_path: Path) -> None:
    first, both = (fake_spec(tmp_path, ("bake",), digest="chained", chained=chained) for chained in (False, True))
    Watch().run(runner, first)
    result = Watch().run(runner, both)  # nothing is in flight between the stored set and the one after it
    assert result["units"] == 2 + 20 + 1  # census and inventory, and the second set with its seal
    names = [line.strip() for line in (tmp_path / "ended").read_text().splitlines()]
    assert names.index("seal diffuse") < min(i for i, name in enumerate(names) if name.startswith("bake directional"))


@pytest.mark.parametrize(
    ("stages", "expected"),
    [(("bake",), {"elements", "bake", "seal"}), (("bake", "render"), {"elements", "bake", "seal", "render"}),
     (("bake", "render", "train"), {"elements", "bake", "seal", "render", "inputs", "train"})],
)  # fmt: skip
def test_job_runs_only_the_stages_asked_for(
    runner: DaskRunner, tmp_path: Path, stages: tuple[str, ...], expected: set[str]
) -> None:
    result = Watch().run(runner, fake_spec(tmp_path, stages, digest="stages-" + "-".join(stages)))
    assert {name.split()[0] for name, _, _ in started(tmp_path)} == expected | {"census", "inventory"}
    assert result["evaluation"] is None


def test_frame_that_fails_three_times_is_set_aside_and_the_job_goes_on(runner: DaskRunner, tmp_path: Path) -> None:
    watch = Watch()
    result = watch.run(runner, fake_spec(tmp_path, digest="aside", failing=["render train 1", "inputs train 2"]))
    reason = "ValueError: render train 1 is broken"
    assert {"unit": "render train 1", "reason": reason, "attempts": 3} in result["set_aside"]
    assert {event["unit"] for event in watch.of("set_aside")} == {"render train 1", "inputs train 2"}
    assert result["evaluation"]["without"] == ["train/1", "train/2"]
    tries = [pid for name, pid, _ in started(tmp_path) if name == "render train 1"]
    assert len(tries) == 3
    assert len(set(tries)) == 2, "on both workers"
    assert [event["attempt"] for event in watch.of("retry") if event["unit"] == "render train 1"] == [1, 2]


def test_bake_unit_set_aside_fails_the_job_once_the_rest_is_done(runner: DaskRunner, tmp_path: Path) -> None:
    with pytest.raises(JobFailed, match=r"bake diffuse 4-4: ValueError: .* is broken.*seal diffuse"):
        Watch().run(runner, fake_spec(tmp_path, digest="fatal", failing=["bake diffuse 4-4"]))
    ended = (tmp_path / "ended").read_text().splitlines()
    assert sum(name.startswith("bake") for name in ended) == 19
    assert sum(name.startswith("render") for name in ended) == 6
    assert not any(name.startswith("inputs") for name in ended)


def test_job_completes_where_a_worker_is_killed(runner: DaskRunner, tmp_path: Path) -> None:
    (tmp_path / "kill bake diffuse 7-7").write_text("1")
    watch = Watch()
    result = watch.run(runner, fake_spec(tmp_path, digest="killed", killing=["bake diffuse 7-7"]))
    assert result["set_aside"] == []
    assert result["units"] == result["planned_units"]
    retries = watch.of("retry")
    assert [(event["unit"], event["attempt"]) for event in retries] == [("bake diffuse 7-7", 1)]
    assert "worker process died" in retries[0]["reason"]


def test_unit_whose_worker_dies_three_times_is_set_aside(runner: DaskRunner, tmp_path: Path) -> None:
    (tmp_path / "kill render test 0").write_text("9")
    result = Watch().run(runner, fake_spec(tmp_path, digest="deadly", killing=["render test 0"]))
    assert [(entry["unit"], entry["attempts"]) for entry in result["set_aside"]] == [("render test 0", 3)]
    assert (tmp_path / "kill render test 0").read_text() == "6"
    assert result["evaluation"]["without"] == ["test/0"]


def test_stop_takes_effect_within_a_pass(runner: DaskRunner, tmp_path: Path) -> None:
    watch, ended = Watch(), {}

    def run() -> None:
        try:
            watch.run(runner, fake_spec(tmp_path, digest="stop", seconds=20.0))
        except JobStopped as error:
            ended["stop"], ended["at"] = error.stop, time.monotonic()

    thread = threading.Thread(target=run)
    thread.start()
    wait_for((tmp_path / "started").exists)
    asked, watch.stop = time.monotonic(), "cancel"
    thread.join(timeout=10)
    assert ended["stop"] == "cancel"
    assert ended["at"] - asked < 1.0
    # Its workers are free after one pass of two seconds, not after the twenty of the unit.
    Watch().run(runner, fake_spec(tmp_path, ("bake",), digest="next"))
    assert time.monotonic() - asked < 8.0


def test_stop_replaces_a_process_that_does_not_listen(
    runner: DaskRunner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.unit_board.SECONDS_TO_LEAVE", 0.5)
    watch = Watch()
    spec = fake_spec(tmp_path, seconds=60.0, deaf=True)
    thread = threading.Thread(target=watch.run_until_stopped, args=(runner, spec))
    thread.start()
    wait_for((tmp_path / "started").exists)
    time.sleep(0.2)
    watch.stop = "cancel"
    asked = time.monotonic()
    thread.join(timeout=10)
    wait_for(lambda: runner.slots < 2, 10)
    wait_for(lambda: runner.slots == 2, 20)
    assert time.monotonic() - asked < 20


def test_jobs_that_run_together_compute_shared_units_once(runner: DaskRunner, tmp_path: Path) -> None:
    watches = [Watch(), Watch()]
    results: dict[int, dict[str, Any]] = {}

    def run(index: int) -> None:
        spec = fake_spec(tmp_path, digest="shared", variant=index, seconds=0.05)
        results[index] = watches[index].run(runner, spec)

    threads = [threading.Thread(target=run, args=(index,)) for index in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60)
    counts = Counter(name for name, _, _ in started(tmp_path))
    own = {"census", "inventory", "train", "evaluate"}
    assert {name for name, count in counts.items() if count > 1} == own
    assert results[0]["network_key"] != results[1]["network_key"]


def test_job_goes_on_where_another_that_shared_its_units_is_cancelled(runner: DaskRunner, tmp_path: Path) -> None:
    watches = [Watch(), Watch()]
    spec = fake_spec(tmp_path, ("bake",), digest="outlive", seconds=0.1)
    threads = [
        threading.Thread(target=watches[0].run_until_stopped, args=(runner, spec)),
        threading.Thread(target=watches[1].run, args=(runner, spec)),
    ]
    for thread in threads:
        thread.start()
    wait_for(lambda: (tmp_path / "ended").exists() and "bake" in (tmp_path / "ended").read_text())
    watches[0].stop = "cancel"
    for thread in threads:
        thread.join(timeout=60)
    assert max(Counter(name for name, _, _ in started(tmp_path)).values()) == 1
    assert sum(name.startswith("bake") for name in (tmp_path / "ended").read_text().splitlines()) == 20


def test_worker_processes_are_recycled_by_count_without_a_failure(tmp_path: Path) -> None:
    recycling = Recycling(units=15)
    with DaskRunner(
        str(tmp_path / "store"), threads=ThreadPolicy(), recycling=recycling, executor=fake_execute
    ) as runner:
        watch = Watch()
        result = watch.run(runner, fake_spec(tmp_path, ("bake",)))
    assert result["set_aside"] == [] and watch.of("retry") == []
    per_process = Counter(pid for _, pid, _ in started(tmp_path))
    assert len(per_process) == 2
    assert max(per_process.values()) <= 15 + 1


def test_close_pauses_the_jobs_that_run(tmp_path: Path) -> None:
    runner = DaskRunner(str(tmp_path / "store"), threads=ThreadPolicy(), executor=fake_execute)
    caught: list[BaseException] = []

    def run() -> None:
        try:
            Watch().run(runner, fake_spec(tmp_path, seconds=5.0))
        except JobStopped as error:
            caught.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    wait_for((tmp_path / "started").exists)
    runner.close()
    thread.join(timeout=10)
    assert [error.stop for error in caught] == ["pause"]  # type: ignore[attr-defined]
