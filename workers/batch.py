"""Plans and runs a batch: every combination is a scene variant with its own digest, run by the stages of any run.

A combination that fails is told with its reason, and the batch goes on with the others. Frames that two combinations
share, or that an earlier run made, are found in the store and not rendered again.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from storage.errors import StorageError
from storage.layout import scene_file
from storage.store import Store
from workers.bake import run_bake
from workers.batch_frames import FrameUnit, frame_units, render_frames
from workers.batch_matrix import BatchItem
from workers.element_stage import run_elements
from workers.errors import WorkerError
from workers.pipeline import run_scene
from workers.plan_stage import planned_run
from workers.progress import Progress
from workers.run_state import RunState
from workers.scene import Scene, load_scene
from workers.settings import Settings


@dataclass(frozen=True)
class ItemResult:
    """What became of one combination.

    Attributes:
        label: its name in the batch.
        scene: name of the variant; empty where it could not be loaded.
        digest: its digest, likewise.
        num_frames: frames that it has.
        num_rendered: those that this run rendered.
        seconds: wall seconds.
        error: why it failed; None where it did not.
    """

    label: str
    scene: str
    digest: str
    num_frames: int
    num_rendered: int
    seconds: float
    error: str | None = None

    def to_json(self) -> dict[str, Any]:
        return dict(vars(self))


def open_items(items: list[BatchItem], store: Store, progress: Progress) -> Iterator[tuple[BatchItem, RunState]]:
    """The runs of a batch, one after the other; a scene that several presets share is loaded once.

    Raises:
        WorkerError: a scene or its settings are not valid.
    """
    loader = _Loader()
    for item in items:
        yield item, _open_item(item, store, progress, loader)


class _Loader:
    """Keeps the scene that was loaded last: presets of one variant follow each other."""

    def __init__(self) -> None:
        self._asked: tuple[str, tuple[int, int] | None] | None = None
        self._scene: Scene | None = None

    def load(self, item: BatchItem) -> Scene:
        if self._scene is None or self._asked != (item.scene, item.resolution):
            self._asked = self._scene = None  # frees the one before, also where the next cannot be loaded
            width, height = item.resolution or (None, None)
            self._scene = load_scene(item.scene, width=width, height=height)
            self._asked = (item.scene, item.resolution)
        return self._scene


def _open_item(item: BatchItem, store: Store, progress: Progress, loader: _Loader) -> RunState:
    """The run of one combination: preset, then what the scene's file asks for, then the batch's settings."""
    scene = loader.load(item)
    if item.settings is not None:
        return planned_run(RunState(scene, store, item.settings, progress))
    size = {"width": scene.camera.width, "height": scene.camera.height}
    settings = Settings.preset_named(item.preset_name).choose({**size, **scene.settings, **item.overrides})
    return planned_run(RunState(scene, store, settings, progress))


def plan_batch(items: list[BatchItem], store: Store, progress: Progress) -> list[dict[str, Any]]:
    """One row a combination: its variant, what it changes, frames in all and missing, paths still to be traced."""
    rows = []
    for item, run in open_items(items, store, progress):
        units = frame_units(run, item.input_spp)
        missing = [unit for unit in units if store.committed(unit.ref) is None]
        pixels = run.settings.width * run.settings.height
        rows.append({
            "label": item.label, "scene": run.scene.name, "digest": run.scene.digest, "stages": list(item.stages),
            "variation": dict(run.scene.variation), "width": run.settings.width, "height": run.settings.height,
            "num_frames": len(units), "num_missing": len(missing),
            "paths": sum(unit.spp for unit in missing) * pixels, "notes": list(run.scene.notes),
        })  # fmt: skip
    return rows


def run_batch(items: list[BatchItem], store: Store, progress: Progress) -> list[ItemResult]:
    """Runs every combination; what is committed already is not computed again."""
    results, loader = [], _Loader()
    with progress.track("batch", len(items)) as advance:
        for item in items:
            result = _run_or_tell(item, store, progress, loader)
            if result.error is not None:
                progress.message(f"{result.label} failed: {result.error}")
            results.append(result)
            advance(1, item.label)
    return results


def _run_or_tell(item: BatchItem, store: Store, progress: Progress, loader: _Loader) -> ItemResult:
    start = time.perf_counter()
    name = digest = ""
    units: list[FrameUnit] = []
    missing: set[Any] = set()
    error = None
    try:
        run = _open_item(item, store, progress, loader)
        name, digest = run.scene.name, run.scene.digest
        units = frame_units(run, item.input_spp)
        missing = {unit.ref for unit in units if store.committed(unit.ref) is None}
        run_item(item, run, units)
    except (WorkerError, StorageError) as failure:
        error = " ".join(str(failure).split())
    rendered = sum(store.committed(ref) is not None for ref in missing)
    return ItemResult(item.label, name, digest, len({unit.ref for unit in units}), rendered,
                      time.perf_counter() - start, error)  # fmt: skip


def run_item(item: BatchItem, run: RunState, units: list[FrameUnit]) -> None:
    """Runs one combination's stages; its frames always, for a dataset is made of them."""
    scene = run.scene
    # Not by listing what the store knows: a batch has as many scenes as combinations.
    if run.store.files.read(scene_file(scene.digest)) is None:
        facts = {"name": scene.name, "source": scene.address, "variation": dict(scene.variation)}
        run.store.register_scene(scene.digest, facts)
    render_frames(run, units)
    if "train" in item.stages:  # the pipeline trains and measures in one go; the frames are there by now
        run_scene(scene, run.store, run.settings, run.progress)
    elif "bake" in item.stages:
        run_bake(run, run_elements(run))
