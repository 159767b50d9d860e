"""What the operating points of one scene are made of, opened when a point first needs it, shared, and dropped again.

Element sets, caches, query programs and networks are kept in one order of use: where their memory is wanted, those
used longest ago go first, and are opened again when a point needs them.
"""

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np
from cachetools import LRUCache

from storage.keys import canonical_json
from storage.store import UnitRef
from workers.bake import bake_refs, load_caches
from workers.element_stage import elements_ref, run_elements
from workers.elements import ElementSet
from workers.footprint import network_nbytes, program_nbytes
from workers.operating_points import OperatingPoint
from workers.query import CHANNELS, CacheArrays, QueryProgram
from workers.reconstruct import Reconstructor
from workers.run_state import RunState
from workers.settings import Settings
from workers.train import load_network
from workers.upsample import HalfScaleReconstructor

Reconstruct = Callable[[np.ndarray], np.ndarray]
Size = tuple[int, int]


def derived_run(run: RunState, settings: Settings) -> RunState:
    """A run of the same scene and camera paths with other caches, query or network.

    Args:
        run: what it derives from.
        settings: as the run's, but for `cache`, `query` and `train`.
    """
    derived = RunState(run.scene, run.store, settings, run.progress)
    derived.table, derived.paths = run.table, run.paths  # both take seconds and depend on neither
    return derived


@dataclass(eq=False)
class Part:
    """One opened thing.

    Attributes:
        value: the thing.
        nbytes: its memory.
        sizes: (width, height) of the frames that it has made.
    """

    value: Any
    nbytes: int
    sizes: set[Size] = field(default_factory=set)


@dataclass(eq=False)
class OpenedPoint:
    """The query program and the reconstruction of a point, and which sizes they have met."""

    query: Part
    network: Part
    num_recordings: int

    @property
    def program(self) -> QueryProgram:
        program: QueryProgram = self.query.value
        return program

    @property
    def reconstruct(self) -> Reconstruct:
        reconstruct: Reconstruct = self.network.value
        return reconstruct

    def has_met(self, size: Size) -> bool:
        """Whether a frame of this size recorded no program and met no new shape; asked after it was made."""
        is_recorded = self.program.num_recordings == self.num_recordings
        return is_recorded and size in self.query.sizes and size in self.network.sizes

    def meet(self, size: Size) -> None:
        """Notes that a frame of this size was made."""
        self.num_recordings = self.program.num_recordings
        self.query.sizes.add(size)
        self.network.sizes.add(size)


class PointParts:
    """Element sets, caches, query programs and networks of the points of one scene.

    Args:
        run: with the settings that the points' overrides change.
    """

    def __init__(self, run: RunState) -> None:
        self.run = run
        self._parts: LRUCache[Hashable, Part] = LRUCache(math.inf, getsizeof=lambda part: part.nbytes)
        self._program_keys: dict[bytes, bytes] = {}

    @property
    def nbytes(self) -> int:
        """Memory of all parts."""
        return int(self._parts.currsize)

    def fit(self, nbytes: int) -> None:
        """Drops parts, the one used longest ago first, until they hold at most `nbytes`."""
        while self._parts and self._parts.currsize > nbytes:
            self._parts.popitem()

    def open(self, point: OperatingPoint) -> OpenedPoint:
        """What makes a point's frames; opened where it is not."""
        query = self._program(point.overrides)
        network = self._network(point.network, point.precision, point.scale)
        return OpenedPoint(query, network, query.value.num_recordings)

    def program(self, overrides: dict[str, Any]) -> QueryProgram:
        """The query of a point's caches."""
        program: QueryProgram = self._program(overrides).value
        return program

    def reconstruct(self, network: str | None, precision: str, scale: int) -> Reconstruct:
        """From features to radiance."""
        reconstruct: Reconstruct = self._network(network, precision, scale).value
        return reconstruct

    def _program(self, overrides: dict[str, Any]) -> Part:
        name = canonical_json(overrides)
        known = self._parts.get(self._program_keys.get(name))
        if known is not None:  # keys cost milliseconds: they hash the whole camera path
            return known
        run = derived_run(self.run, self.run.settings.override(overrides))
        elements = self._elements(run)
        cache = run.settings.cache
        refs = {name: ref.key for name, ref in bake_refs(run, elements).items()}
        caches_key = canonical_json([refs, cache.denoise, cache.demodulate, cache.lobes])
        key = self._program_keys[name] = canonical_json([caches_key.decode(), vars(run.settings.query)])

        def make() -> tuple[QueryProgram, int]:
            caches = self._kept(caches_key, lambda: _sized(load_caches(run, elements))).value
            program = QueryProgram(run.scene.mi_scene, run.table, elements, caches, run.settings.query)
            return program, program_nbytes(program)

        return self._kept(key, make)

    def _elements(self, run: RunState) -> ElementSet:
        elements: ElementSet = self._kept(elements_ref(run), lambda: _sized(run_elements(run))).value
        return elements

    def _network(self, network: str | None, precision: str, scale: int) -> Part:
        return self._kept((network, precision, scale), lambda: self._loaded(network, precision, scale))

    def _loaded(self, network: str | None, precision: str, scale: int) -> tuple[Reconstruct, int]:
        if network is None:
            return imperfect_radiance, 0
        loaded, encoding = load_network(self.run, UnitRef(self.run.scene.digest, "train", network))
        reconstructor = Reconstructor(loaded, encoding, precision=precision)
        nbytes = network_nbytes(reconstructor)
        return (reconstructor if scale == 1 else HalfScaleReconstructor(reconstructor)), nbytes

    def _kept(self, key: Hashable, make: Callable[[], tuple[Any, int]]) -> Part:
        part = self._parts.get(key)
        if part is None:
            part = self._parts[key] = Part(*make())
        return part


def _sized(arrays: ElementSet | CacheArrays) -> tuple[Any, int]:
    return arrays, arrays_nbytes(arrays)


def arrays_nbytes(value: Any) -> int:
    """Bytes of the NumPy arrays of a dataclass and of the dataclasses in it."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if not is_dataclass(value):
        return 0
    return sum(arrays_nbytes(getattr(value, each.name)) for each in fields(value))


def imperfect_radiance(features: np.ndarray) -> np.ndarray:
    """What the caches themselves say: a frame without a network."""
    a, b = CHANNELS["ir"]
    return np.ascontiguousarray(features[..., a:b])
