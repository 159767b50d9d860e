"""Frames of a scene at its operating points: parts are opened when a point first needs them, and shared."""

from collections.abc import Callable
from typing import Any

import numpy as np

from storage.keys import canonical_json
from storage.store import UnitRef
from workers.bake import bake_refs, load_caches
from workers.camera import Camera
from workers.element_stage import elements_ref, run_elements
from workers.elements import ElementSet
from workers.errors import OperatingPointError
from workers.network_record import load_network
from workers.operating_points import OperatingPoint
from workers.operating_table import OperatingTable, load_table
from workers.query import CHANNELS, CacheArrays, QueryProgram
from workers.reconstruct import Reconstructor
from workers.renderer import Frame, FrameRenderer, make_frame
from workers.run_state import RunState
from workers.settings import Settings
from workers.upsample import HalfScaleReconstructor

Reconstruct = Callable[[np.ndarray], np.ndarray]


def derived_run(run: RunState, settings: Settings) -> RunState:
    """A run of the same scene and camera paths with other caches, query or network.

    Args:
        run: what it derives from.
        settings: as the run's, but for `cache`, `query` and `train`.
    """
    derived = RunState(run.scene, run.store, settings, run.progress)
    derived.table, derived.paths = run.table, run.paths  # both take seconds and depend on neither
    return derived


class PointParts:
    """Element sets, caches, query programs and networks of the points of one scene.

    Args:
        run: with the settings that the points' overrides change.
    """

    def __init__(self, run: RunState) -> None:
        self.run = run
        self._elements: dict[UnitRef, ElementSet] = {}
        self._caches: dict[bytes, CacheArrays] = {}
        self._programs: dict[bytes, QueryProgram] = {}
        self._reconstructors: dict[tuple[str | None, str, int], Reconstruct] = {}

    def program(self, overrides: dict[str, Any]) -> QueryProgram:
        """The query of a point's caches."""
        run = derived_run(self.run, self.run.settings.override(overrides))
        elements = self._elements_of(run)
        cache = run.settings.cache
        refs = {name: ref.key for name, ref in bake_refs(run, elements).items()}
        caches_key = canonical_json([refs, cache.denoise, cache.demodulate, cache.lobes])
        if caches_key not in self._caches:
            self._caches[caches_key] = load_caches(run, elements)
        key = canonical_json([caches_key.decode(), vars(run.settings.query)])
        if key not in self._programs:
            self._programs[key] = QueryProgram(
                run.scene.mi_scene, run.table, elements, self._caches[caches_key], run.settings.query
            )
        return self._programs[key]

    def _elements_of(self, run: RunState) -> ElementSet:
        ref = elements_ref(run)
        if ref not in self._elements:
            self._elements[ref] = run_elements(run)
        return self._elements[ref]

    def reconstruct(self, network: str | None, precision: str, scale: int) -> Reconstruct:
        """From features to radiance."""
        key = (network, precision, scale)
        if key not in self._reconstructors:
            self._reconstructors[key] = self._opened(network, precision, scale)
        return self._reconstructors[key]

    def _opened(self, network: str | None, precision: str, scale: int) -> Reconstruct:
        if network is None:
            return imperfect_radiance
        loaded, encoding = load_network(self.run, UnitRef(self.run.scene.digest, "train", network))
        reconstructor = Reconstructor(loaded, encoding, precision=precision)
        return reconstructor if scale == 1 else HalfScaleReconstructor(reconstructor)


def imperfect_radiance(features: np.ndarray) -> np.ndarray:
    """What the caches themselves say: a frame without a network."""
    a, b = CHANNELS["ir"]
    return np.ascontiguousarray(features[..., a:b])


class PointRenderer(FrameRenderer):
    """The scene's published run, and its operating points."""

    _parts: PointParts | None = None
    _table: OperatingTable | None = None

    def render(self, camera: Camera, point: OperatingPoint | None = None) -> Frame:
        """Makes the frame of a camera, as the published run does where no point is given.

        The first frame of a point loads its caches and network; the first of a size compiles its query.

        Raises:
            NoOperatingPointsError, OperatingPointError: the store has no such point (any more).
            StorageError: a part of it is missing.
        """
        if point is None:
            return super().render(camera)
        parts = self._parts_of(point)
        reconstruct = parts.reconstruct(point.network, point.precision, point.scale)
        exposure = self.reconstructor.encoding.exposure
        return make_frame(parts.program(point.overrides), reconstruct, exposure, camera)

    def _parts_of(self, point: OperatingPoint) -> PointParts:
        """The parts of the table that has the point; a table that was measured again replaces the old one."""
        if self.run is None:
            raise OperatingPointError("a renderer must come from PointRenderer.open to know its operating points")
        if self._parts is None or self._table is None or point not in self._table.points:
            table = load_table(self.run.store, self.run.scene.digest)
            if point not in table.points:
                raise OperatingPointError(
                    f"operating point must be one that the store has, got {point.name!r} as it was measured before; "
                    "choose again"
                )
            self._table = table
            self._parts = PointParts(derived_run(self.run, Settings.from_json(table.base)))
        return self._parts
