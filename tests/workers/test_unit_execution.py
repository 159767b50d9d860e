"""Units of the real stages: the same bytes as the pipeline in one process, refused where the scene changed."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from storage.layout import UnitRef
from storage.store import Store
from tests.torture.tiny_job import ROOT, committed, differences, tiny_spec
from workers.errors import ChangedSceneError, StoppedError
from workers.job_spec import JobSpec
from workers.loaded_run import forget_runs
from workers.progress import Progress
from workers.thread_policy import ThreadPolicy
from workers.unit_execution import RESULT_FILE, execute
from workers.units import CENSUS, Census, Inventory, Unit, blocks_after_census, blocks_after_inventory, by_priority

SETTINGS = {"train.epochs": 1, "cache.elements_per_unit": 512, "evaluation.timing_repeats": 1}


class Stopping(Progress):
    """Stops at the n-th pass."""

    def __init__(self, passes: int) -> None:
        self.left = passes

    def between_passes(self) -> None:
        self.left -= 1
        if self.left <= 0:
            raise StoppedError("stopped")


def run_units(spec: JobSpec, store_url: str, *, reverse: bool = False) -> tuple[Census, Any]:
    """Every unit of a run, by a loop that is no engine."""
    answer = None

    def do(unit: Unit) -> Any:
        return execute(unit, spec, store_url, Progress())

    census = Census.from_json(do(CENSUS[0]))
    blocks = blocks_after_census(census, spec.last_stage)
    ordered = sorted(blocks, key=by_priority)
    for block in ordered:
        units = list(block.pending(()))
        for unit in reversed(units) if reverse else units:
            answer = do(unit)
            if unit.stage == "inventory":
                more = blocks_after_inventory(census, Inventory.from_json(answer), spec.last_stage)
                ordered += sorted(more, key=by_priority)
    return census, answer


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What the pipeline in a process of its own commits."""
    store = tmp_path_factory.mktemp("undisturbed") / "store"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "tests.torture.undisturbed", str(store), json.dumps(SETTINGS)]
    subprocess.run(command, cwd=ROOT, env=environment, check=True, capture_output=True)
    return committed(store)


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Census, str]:
    store = tmp_path_factory.mktemp("units") / "store"
    ThreadPolicy().apply("train")
    census, key = run_units(tiny_spec(**SETTINGS), str(store), reverse=True)
    return store, census, key


def test_units_in_any_order_make_the_pipelines_bytes(
    ran: tuple[Path, Census, str], undisturbed: dict[str, str]
) -> None:
    found = committed(ran[0])
    assert len(found) > 30
    assert differences(undisturbed, found) == []


def test_evaluation_is_kept_and_not_measured_again(ran: tuple[Path, Census, str]) -> None:
    store, census, key = Store.open(ran[0]), ran[1], ran[2]
    ref = UnitRef(census.digest, "evaluation", key)
    rows = json.loads(store.read(ref, RESULT_FILE))["rows"]
    assert rows[0]["name"] == "ours" and rows[0]["psnr"] > 10
    created = store.committed(ref)
    evaluate = Unit("evaluate")
    assert execute(evaluate, tiny_spec(**SETTINGS), store.url, Progress()) == key
    assert store.committed(ref) == created


def test_evaluation_goes_on_without_a_frame_that_was_set_aside(ran: tuple[Path, Census, str]) -> None:
    store, census = Store.open(ran[0]), ran[1]
    key = execute(Unit("evaluate", without=("test/1",)), tiny_spec(**SETTINGS), store.url, Progress())
    assert key != ran[2]
    params = (store.committed(UnitRef(census.digest, "evaluation", key)) or {})["params"]
    assert params["tests"] == [census.renders["test"][0]]


def test_unit_of_a_scene_that_changed_is_refused(ran: tuple[Path, Census, str]) -> None:
    unit = Unit("render", "train", 0, 1, key="0" * 32)
    with pytest.raises(ChangedSceneError, match="render train 0 must still be what was planned"):
        execute(unit, tiny_spec(**SETTINGS), str(ran[0]), Progress())


@pytest.mark.parametrize("passes", [1, 2])
def test_stop_between_passes_leaves_nothing_half_done(
    tmp_path: Path, ran: tuple[Path, Census, str], passes: int
) -> None:
    spec, census = tiny_spec(**SETTINGS), ran[1]
    unit = Unit("render", "train", 1, 1, key=census.renders["train"][1])
    with pytest.raises(StoppedError):
        execute(unit, spec, str(tmp_path / "store"), Stopping(passes))
    store = Store.open(tmp_path / "store")
    ref = UnitRef(census.digest, "render", unit.key)
    assert store.committed(ref) is None
    assert execute(unit, spec, store.url, Progress()) == unit.key
    theirs = Store.open(ran[0]).committed(ref) or {}
    assert (store.committed(ref) or {})["files"] == theirs["files"]


def test_stopped_training_leaves_a_checkpoint_of_the_step_it_stopped_at(ran: tuple[Path, Census, str]) -> None:
    from contextlib import contextmanager

    class StopsAtStep(Progress):
        @contextmanager
        def track(self, description: str, total: float):  # type: ignore[no-untyped-def]
            steps = 0

            def advance(amount: float = 1.0, note: str = "") -> None:
                nonlocal steps
                steps += 1
                if steps > 3:  # the first call tells where it starts
                    raise StoppedError("stopped")

            yield advance

    spec = tiny_spec(**{**SETTINGS, "train.epochs": 2})
    with pytest.raises(StoppedError):
        execute(Unit("train"), spec, str(ran[0]), StopsAtStep())
    store, digest = Store.open(ran[0]), ran[1].digest
    checkpoints = store.units(digest, "checkpoint")
    assert [(store.committed(ref) or {})["step"] for ref in checkpoints] == [3]
    execute(Unit("train"), spec, store.url, Progress())
    assert store.units(digest, "checkpoint") == []


def test_runs_of_other_settings_share_the_loaded_scene(ran: tuple[Path, Census, str]) -> None:
    from workers.loaded_run import open_run

    spec = tiny_spec(**SETTINGS)
    other = dataclasses.replace(spec, settings=tiny_spec(**{**SETTINGS, "train.epochs": 2}).settings)
    one, two = (open_run(s, str(ran[0]), Progress()) for s in (spec, other))
    assert one is not two and one.run.scene is two.run.scene
    assert open_run(spec, str(ran[0]), Progress()) is one
    forget_runs()
    assert open_run(spec, str(ran[0]), Progress()) is not one
