"""Stages that answer at once: an executor for the engine's tests, in a module of its own as workers import it."""

import json
import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from storage.caches import ArraySpec, CacheSet
from storage.frames import encode_frame
from storage.keys import unit_key
from storage.layout import UnitRef
from storage.store import Store
from workers.job_spec import JobSpec
from workers.progress import Progress
from workers.units import Unit

DIGEST = "fa4e"
PASSES = 10
FRAMES = {"train": 3, "validation": 1, "test": 2}


def key_of(stage: str, *what: Any) -> str:
    return unit_key(DIGEST, stage, {"what": list(what)}, 1)


@dataclass(frozen=True)
class FakeStages:
    """Does what the stages do to a store, in `seconds` a unit.

    Attributes:
        folder: where it writes which unit ran in which process; one line a start.
        seconds: of a unit, in `PASSES` passes.
        num_bake_units: of its one cache set.
        failing: names of units that always fail.
        killing: names of units whose process is killed, for as long as `folder/kill <name>` holds lives.
    """

    folder: Path
    seconds: float = 0.0
    num_bake_units: int = 20
    failing: tuple[str, ...] = ()
    killing: tuple[str, ...] = ()
    deaf: bool = False

    def __call__(self, unit: Unit, spec: JobSpec, store_url: str, progress: Progress) -> Any:
        with (self.folder / "started").open("a") as log:
            log.write(f"{unit.name} {os.getpid()} {spec.settings.get('variant', 0)}\n")
        with progress.track(unit.name, PASSES) as advance:
            for _ in range(PASSES):
                time.sleep(self.seconds / PASSES)
                if not self.deaf:
                    advance(note="pass")
        if unit.name in self.failing:
            raise ValueError(f"{unit.name} is broken")
        if unit.name in self.killing:
            self._die(unit)
        store = Store.open(store_url, create=True)
        answer = getattr(self, f"_{unit.stage}")(unit, spec, store)
        with (self.folder / "ended").open("a") as log:
            log.write(f"{unit.name}\n")
        return answer

    def _die(self, unit: Unit) -> None:
        lives = self.folder / f"kill {unit.name}"
        left = int(lives.read_text()) if lives.exists() else 0
        if left > 0:
            lives.write_text(str(left - 1))
            time.sleep(0.1)  # so that the news of its start is out, as it is with real units
            os.kill(os.getpid(), signal.SIGKILL)

    def _census(self, unit: Unit, spec: JobSpec, store: Store) -> dict[str, Any]:
        renders = {path: [key_of("render", path, i) for i in range(count)] for path, count in FRAMES.items()}
        return {"digest": DIGEST, "elements": key_of("elements"), "renders": renders}

    def _inventory(self, unit: Unit, spec: JobSpec, store: Store) -> dict[str, Any]:
        lobes = {"diffuse": {"key": key_of("bake"), "num_units": self.num_bake_units, "lanes_per_unit": 1000}}
        inputs = {path: [key_of("inputs", path, i) for i in range(FRAMES[path])] for path in ("train", "validation")}
        return {"lobes": lobes, "inputs": inputs}

    def _elements(self, unit: Unit, spec: JobSpec, store: Store) -> str:
        return self._commit(store, "elements", unit.key)

    def _caches(self, unit: Unit, store: Store) -> CacheSet:
        spec = ArraySpec("mean", (self.num_bake_units * 2, 3), "float32", 2)
        return CacheSet.create_or_open(store, UnitRef(DIGEST, "bake", unit.key), [spec], {})

    def _bake(self, unit: Unit, spec: JobSpec, store: Store) -> str:
        caches = self._caches(unit, store)
        for index in range(unit.first, unit.first + unit.count):
            caches.write_unit(index, {"mean": np.full((2, 3), index, np.float32)}, {"seconds": 0})
        return unit.key

    def _seal(self, unit: Unit, spec: JobSpec, store: Store) -> str:
        self._caches(unit, store).commit({})
        return unit.key

    def _render(self, unit: Unit, spec: JobSpec, store: Store) -> str:
        frame = encode_frame({"radiance": np.full((4, 6, 3), 0.5, np.float32)})
        return self._commit(store, "render", unit.key, {"frame.exr": frame})

    def _inputs(self, unit: Unit, spec: JobSpec, store: Store) -> str:
        return self._commit(store, "inputs", unit.key)

    def _train(self, unit: Unit, spec: JobSpec, store: Store) -> str:
        return self._commit(store, "train", key_of("train", *unit.without, spec.settings.get("variant", 0)))

    def _evaluate(self, unit: Unit, spec: JobSpec, store: Store) -> str:
        scores = {"rows": [{"name": "ours", "psnr": float("inf")}], "without": list(unit.without)}
        key = key_of("evaluation", *unit.without, spec.settings.get("variant", 0))
        return self._commit(store, "evaluation", key, {"evaluation.json": json.dumps(scores).encode()})

    def _commit(self, store: Store, stage: str, key: str, files: dict[str, bytes] | None = None) -> str:
        store.commit(UnitRef(DIGEST, stage, key), files or {"data": stage.encode()}, {})
        return key
