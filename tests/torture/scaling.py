"""What the engine costs, and what a second worker gives: `python -m tests.torture.scaling [--overhead]`.

Overhead: units that sleep for ten seconds against the time that they sleep. Scaling: the same real job (bake and frames
of the tiny scene, made larger) on one and on two single-threaded workers, after a small job has warmed them up.
"""

import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from service.engine import DaskRunner
from tests.service.fake_stages import fake_execute, fake_spec
from tests.torture.tiny_job import tiny_spec
from workers.job_spec import STAGES, JobSpec
from workers.thread_policy import ThreadPolicy

UNIT_SECONDS = 10.0
NUM_UNITS = 4
# Units of a second or more, as real ones are: below that, what counts is the flush of each file to the disk.
WORK = {"cache.max_elements": 6500, "cache.elements_per_unit": 128, "cache.diffuse_spp": 8192,
        "cache.directional_spp": 256, "frames.num_train": 8, "frames.num_test": 1, "frames.train_spp": 512,
        "frames.test_spp": 512}  # fmt: skip
# The same kernels on other elements and frames: each process compiles them for some seconds, once.
WARM = {**WORK, "cache.max_elements": 400, "cache.elements_per_unit": 32, "frames.train_spp": 34,
        "frames.test_spp": 34}  # fmt: skip


def timed(runner: DaskRunner, spec: JobSpec) -> tuple[float, dict[str, float], dict[str, Any]]:
    """Seconds of a job, and of the last event of each stage."""
    start, stages = time.perf_counter(), {}

    def note(event: dict[str, Any]) -> None:
        if event["kind"] == "progress":
            stages[event["stage"]] = time.perf_counter() - start

    result = runner.run("scaling", spec, note, lambda: None)
    return time.perf_counter() - start, stages, result


def overhead(folder: Path) -> float:
    """Share of a unit's time that the engine adds, with one worker."""
    options: dict[str, Any] = {"threads": ThreadPolicy(), "executor": fake_execute}
    behaviour: dict[str, Any] = {"num_bake_units": NUM_UNITS, "slow": "bake", "seconds": UNIT_SECONDS}
    with DaskRunner(str(folder / "fakes"), **options) as runner:
        timed(runner, fake_spec(folder, ("bake",), digest="warm"))
        seconds, stages, _ = timed(runner, fake_spec(folder, ("bake",), digest="cold", **behaviour))
    baked = stages["bake diffuse"] - stages["inventory"]
    print(f"{NUM_UNITS} units of {UNIT_SECONDS:g} s: {baked:.3f} s, whole job {seconds:.3f} s")
    return baked / (NUM_UNITS * UNIT_SECONDS) - 1


def throughput(folder: Path, num_workers: int) -> float:
    """Units a second of the real job."""
    with DaskRunner(str(folder / f"workers-{num_workers}"), num_workers=num_workers, threads=ThreadPolicy()) as runner:
        for _ in range(num_workers):  # a store of its own each time would load the scene again
            timed(runner, tiny_spec_until("render", WARM))
        seconds, stages, result = timed(runner, tiny_spec_until("render", WORK))
    print(f"{num_workers} workers: {result['units']} units in {seconds:.2f} s, stages ended at "
          f"{ {name: round(at, 1) for name, at in stages.items()} }")  # fmt: skip
    return result["units"] / seconds


def tiny_spec_until(stage: str, settings: dict[str, Any]) -> JobSpec:
    return JobSpec(scene="tiny", settings=tiny_spec(**settings).settings, stages=STAGES[: STAGES.index(stage) + 1])


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as temporary:
        print(
            f"overhead of the engine: {overhead(Path(temporary)):.2%}" if "--overhead" in sys.argv else "", flush=True
        )
        one, two = (throughput(Path(temporary), count) for count in (1, 2))
        print(f"throughput of 2 workers against 1: {two / one:.2f}")
