"""Frames of a prepared scene: what the service asks for."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np

from storage.store import Store, UnitRef
from workers.bake import load_caches
from workers.camera import Camera
from workers.code_versions import ENTRY, check_versions, code_versions
from workers.element_stage import run_elements
from workers.errors import WorkerError
from workers.footprint import scene_nbytes
from workers.network_record import load_network
from workers.progress import Progress
from workers.published import renderable_scenes
from workers.query import CHANNELS, QueryProgram
from workers.reconstruct import Reconstructor
from workers.run_state import RunState
from workers.scene import load_scene
from workers.settings import Settings

__all__ = ["Frame", "FrameRenderer", "open_run", "publish", "renderable_scenes"]


@dataclass(frozen=True)
class Frame:
    """One reconstructed frame.

    Attributes:
        radiance: linear scene radiance, float32 [height, width, 3].
        seconds: wall seconds of "query" and "network"; of "prepare" where something was opened or compiled before.
        coverage: share of radiance lookups answered by baked elements, in [0, 1].
        exposure: the scene's exposure, to show the frame.
        non_finite: values that came NaN or infinite out of the query or the network. They are counted, reported and not
            in `radiance`: the network sees 0 for them, the frame shows the caches' own radiance there.
    """

    radiance: np.ndarray
    seconds: dict[str, float]
    coverage: float
    exposure: float
    non_finite: int


class FrameRenderer:
    """Caches, query program and network of one scene, ready for any camera pose."""

    def __init__(self, program: QueryProgram, reconstructor: Reconstructor, run: RunState | None = None) -> None:
        self.program = program
        self.reconstructor = reconstructor
        self.run = run  # what it was opened from

    @classmethod
    def open(
        cls, store: Store, scene_name: str, *, progress: Progress | None = None, compile: bool = False,
        warm_up: bool = True,
    ) -> Self:  # fmt: skip
        """Loads what `run_scene` prepared.

        Args:
            store: where it lies.
            scene_name: name or digest of the scene.
            progress: where progress goes.
            compile: try a compiled network (tens of seconds a frame size).
            warm_up: render one frame of the run's own size first.

        Raises:
            StorageError, WorkerError: the scene is not in the store, was not run to its end, or has changed.
        """
        entry = store.find_scene(scene_name)
        run, network_ref = open_run(store, entry, progress or Progress())
        network, encoding = load_network(run, network_ref)
        elements = run_elements(run)
        program = QueryProgram(run.scene.mi_scene, run.table, elements, load_caches(run, elements), run.settings.query)
        precision = run.settings.train.precision
        renderer = cls(program, Reconstructor(network, encoding, precision=precision, compile=compile), run)
        if warm_up:
            renderer.render(run.scene.camera.resized(run.settings.width, run.settings.height))
        return renderer

    @cached_property
    def run_nbytes(self) -> int:
        """Memory of the scene, its caches and its network, bytes (`workers/footprint.py`)."""
        return scene_nbytes(self.program, self.reconstructor)

    @property
    def nbytes(self) -> int:
        """Memory that the open scene holds, bytes; what is opened later counts from then on."""
        return self.run_nbytes

    def fit(self, nbytes: int) -> None:
        """Drops what can be opened again until all is within `nbytes` or nothing more can go."""

    def render(self, camera: Camera) -> Frame:
        """Reconstructs the frame of a camera; any pose is answered."""
        return make_frame(self.program, self._network(camera), self.reconstructor.encoding.exposure, camera)

    def unchecked(self, camera: Camera) -> np.ndarray:
        """Radiance as the network gives it, NaN and Inf included: for scores, which must refuse them."""
        return self._network(camera)(self.program.run(camera))

    def _network(self, camera: Camera) -> Callable[[np.ndarray], np.ndarray]:
        """Features to radiance; what is fastest for a new size is measured after queries of this camera."""
        return lambda features: self.reconstructor(features, lambda: self.program.run(camera))


def make_frame(
    program: QueryProgram, reconstruct: Callable[[np.ndarray], np.ndarray], exposure: float, camera: Camera
) -> Frame:
    """Queries a camera and turns the features into its frame."""
    start = time.perf_counter()
    features = program.run(camera)
    queried = time.perf_counter()
    bad_inputs = _finite_in_place(features[..., : CHANNELS["position"][0]], 0.0)
    radiance = reconstruct(features)
    bad_outputs = _finite_in_place(radiance, features[..., slice(*CHANNELS["ir"])])
    finished = time.perf_counter()
    a, b = CHANNELS["coverage"]
    return Frame(
        radiance=radiance,
        seconds={"query": queried - start, "network": finished - queried},
        coverage=float(np.mean(features[..., a:b])),
        exposure=exposure,
        non_finite=bad_inputs + bad_outputs,
    )


def _finite_in_place(values: np.ndarray, instead: np.ndarray | float) -> int:
    """Replaces NaN and Inf and returns how many there were."""
    finite = np.isfinite(values)
    if finite.all():
        return 0
    np.copyto(values, instead, where=~finite)
    return int(values.size - np.count_nonzero(finite))


def publish(run: RunState, network_ref: UnitRef, psnr: float | None) -> None:
    """Makes a finished run the one that its scene is served from."""
    run.store.register_scene(
        run.scene.digest,
        {
            "name": run.scene.name, "source": run.scene.address, "settings": run.settings.to_json(),
            "network": network_ref.key, "width": run.settings.width, "height": run.settings.height,
            "preset": run.settings.preset, "psnr": psnr, ENTRY: code_versions(),
        },
    )  # fmt: skip


def open_run(store: Store, entry: dict[str, Any], progress: Progress) -> tuple[RunState, UnitRef]:
    """The run that a scene is served from and its network.

    Raises:
        WorkerError: the scene was never run to its end, its files have changed since, or another version ran it.
    """
    if "network" not in entry:
        raise WorkerError(
            f"scene {entry['name']!r} must have a trained network in {store.url}, got none; "
            f"run: lightwell run {entry.get('source', 'SCENE')} --store {store.url}"
        )
    check_versions(entry, store.url)
    settings = Settings.from_json(entry["settings"])
    scene = load_scene(entry["source"], width=settings.width, height=settings.height)
    if scene.digest != entry["digest"]:
        raise WorkerError(
            f"scene {entry['name']!r} must be what its caches were baked for, but its files have changed; "
            f"run: lightwell run {entry['source']} --store {store.url}"
        )
    return RunState(scene, store, settings, progress), UnitRef(scene.digest, "train", entry["network"])
