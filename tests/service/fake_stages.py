"""Stages that answer at once: an executor for the engine's tests, in a module of its own as workers import it."""

import json
import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from storage.caches import ArraySpec, CacheSet, marked_units
from storage.frames import encode_frame
from storage.keys import unit_key
from storage.layout import UnitRef
from storage.store import Store
from workers.job_spec import STAGES, JobSpec
from workers.progress import Progress
from workers.units import Unit

PASSES = 10
FRAMES = {"train": 3, "validation": 1, "test": 2}


def fake_spec(folder: Path, stages: tuple[str, ...] = STAGES, **behaviour: Any) -> JobSpec:
    """A job whose units behave as the fields of `FakeStages` say."""
    return JobSpec(scene="fake", settings={"folder": str(folder), **behaviour}, stages=stages)


def fake_execute(unit: Unit, spec: JobSpec, store_url: str, progress: Progress) -> Any:
    return FakeStages(**spec.settings)(unit, store_url, progress)


@dataclass(frozen=True)
class FakeStages:
    """Does what the stages do to a store.

    Attributes:
        folder: where it writes which units were asked for, and which ran in which process; one line a start.
        digest: of its scene; jobs of one digest share units.
        variant: of its training.
        seconds: of a unit, in `PASSES` passes.
        slow: stage whose units take `seconds`; "" for all of them.
        num_bake_units: of each of its cache sets.
        chained: a second cache set is baked once the first is sealed.
        failing: names of units that always fail.
        killing: names of units whose process is killed, for as long as `folder/kill <name>` holds lives.
        deaf: its passes ask nobody whether to go on.
    """

    folder: str
    digest: str = "fa4e"
    variant: int = 0
    seconds: float = 0.0
    slow: str = ""
    num_bake_units: int = 20
    chained: bool = False
    failing: tuple[str, ...] = ()
    killing: tuple[str, ...] = ()
    deaf: bool = False

    def __call__(self, unit: Unit, store_url: str, progress: Progress) -> Any:
        self._note("asked", f"{unit.name},{os.getpid()},{self.variant}")
        if self._is_stored(unit, Store.open(store_url, create=True)):  # by another job since ours looked, say
            return unit.key
        self._note("started", f"{unit.name},{os.getpid()},{self.variant}")
        seconds = self.seconds if self.slow in ("", unit.stage) else 0.0
        with progress.track(unit.name, PASSES) as advance:
            for _ in range(PASSES):
                time.sleep(seconds / PASSES)
                if not self.deaf:
                    advance(note="pass")
        if unit.name in self.failing:
            raise ValueError(f"{unit.name} is broken")
        if unit.name in self.killing:
            self._die(unit)
        answer = getattr(self, f"_{unit.stage}")(unit, Store.open(store_url, create=True))
        self._note("ended", unit.name)
        return answer

    def _is_stored(self, unit: Unit, store: Store) -> bool:
        if unit.stage == "bake":
            done = marked_units(store, UnitRef(self.digest, "bake", unit.key))
            return all(index in done for index in range(unit.first, unit.first + unit.count))
        return bool(unit.key) and store.committed(UnitRef(self.digest, unit.stage, unit.key)) is not None

    def _note(self, file: str, line: str) -> None:
        with Path(self.folder, file).open("a") as log:
            log.write(f"{line}\n")

    def _die(self, unit: Unit) -> None:
        lives = Path(self.folder, f"kill {unit.name}")
        left = int(lives.read_text()) if lives.exists() else 0
        if left > 0:
            lives.write_text(str(left - 1))
            time.sleep(0.1)  # so that the news of its start is out, as it is with real units
            os.kill(os.getpid(), signal.SIGKILL)

    def key(self, stage: str, *what: Any) -> str:
        return unit_key(self.digest, stage, {"what": list(what)}, 1)

    def _census(self, unit: Unit, store: Store) -> dict[str, Any]:
        renders = {path: [self.key("render", path, i) for i in range(count)] for path, count in FRAMES.items()}
        return {"digest": self.digest, "elements": self.key("elements"), "renders": renders}

    def _inventory(self, unit: Unit, store: Store) -> dict[str, Any]:
        size = {"num_units": self.num_bake_units, "lanes_per_unit": 1000}
        lobes = {"diffuse": {"key": self.key("bake"), **size}}
        if self.chained:
            lobes["directional"] = {"key": self.key("bake", "directional"), **size, "after": "diffuse"}
        inputs = {path: [self.key("inputs", path, i) for i in range(FRAMES[path])] for path in ("train", "validation")}
        return {"lobes": lobes, "inputs": inputs}

    def _elements(self, unit: Unit, store: Store) -> str:
        return self._commit(store, "elements", unit.key)

    def _caches(self, unit: Unit, store: Store) -> CacheSet:
        spec = ArraySpec("mean", (self.num_bake_units * 2, 3), "float32", 2)
        return CacheSet.create_or_open(store, UnitRef(self.digest, "bake", unit.key), [spec], {})

    def _bake(self, unit: Unit, store: Store) -> str:
        caches = self._caches(unit, store)
        for index in range(unit.first, unit.first + unit.count):
            caches.write_unit(index, {"mean": np.full((2, 3), index, np.float32)}, {"seconds": 0})
        return unit.key

    def _seal(self, unit: Unit, store: Store) -> str:
        self._caches(unit, store).commit({})
        return unit.key

    def _render(self, unit: Unit, store: Store) -> str:
        frame = encode_frame({"radiance": np.full((4, 6, 3), 0.5, np.float32)})
        return self._commit(store, "render", unit.key, {"frame.exr": frame})

    def _inputs(self, unit: Unit, store: Store) -> str:
        return self._commit(store, "inputs", unit.key)

    def _train(self, unit: Unit, store: Store) -> str:
        return self._commit(store, "train", self.key("train", *unit.without, self.variant))

    def _evaluate(self, unit: Unit, store: Store) -> str:
        scores = {"rows": [{"name": "ours", "psnr": float("inf")}], "without": list(unit.without)}
        key = self.key("evaluation", *unit.without, self.variant)
        files = {"evaluation.json": json.dumps(scores).encode(), "report.html": b"<html>pictures</html>"}
        return self._commit(store, "evaluation", key, files)

    def _commit(self, store: Store, stage: str, key: str, files: dict[str, bytes] | None = None) -> str:
        store.commit(UnitRef(self.digest, stage, key), files or {"data": stage.encode()}, {})
        return key


def started(folder: Path, file: str = "started") -> list[tuple[str, int, int]]:
    """Name, process and variant of every unit that was begun, or "asked" for."""
    rows = (line.rsplit(",", 2) for line in (folder / file).read_text().splitlines())
    return [(name, int(pid), int(variant)) for name, pid, variant in rows]
