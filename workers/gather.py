"""The diffuse caches as a path's end: what a path of a bake meets is often known already.

Most of the noise of a path is light that bounced several times, and a directional texel has few paths. Where a path
meets a purely diffuse surface whose caches were baked (thousands of paths an element, shared with its neighbours), it
takes the radiance from there,

    L_o = L_e + rho_d D,

and ends: final gathering (Jensen 1996), with elements instead of photons. It meets everything else (glossy, delta,
never seen by the cameras) as a plain path does. Where caches interpolate well this changes nothing but the noise; a
shadow finer than their spacing is blurred in its reflection, too.
"""

from typing import Any

import numpy as np

from storage.caches import CacheSet
from storage.store import UnitRef
from workers.backend import dr, mi
from workers.cache_filter import FILTER_VERSION, filter_diffuse
from workers.elements import ElementSet
from workers.lobes import LobeClass, diffuse_reflectance, has
from workers.query_shading import CacheArrays, CacheShading
from workers.run_state import RunState
from workers.settings import CacheSettings
from workers.surfaces import SurfaceTable

GATHER_VERSION = 1  # part of the keys of what is baked with it
# D holds paths of full length wherever it is met. With fewer bounces than this the light beyond the limit would show.
MIN_DEPTH = 8
MIN_BAKED = 0.999  # share of the lookup that baked elements answer, at least: stand-ins are for pictures
MIN_SHARE = 0.1  # of the elements that are purely diffuse, at least: else a first round of D is not worth its paths
_LONGER = int(LobeClass.GLOSSY | LobeClass.DELTA | LobeClass.PRINCIPLED)


def gathers(cache: CacheSettings, max_depth: int, table: SurfaceTable, elements: ElementSet) -> bool:
    """Whether paths of a bake end in diffuse caches: never where hardly any of them could."""
    deep = max_depth < 0 or max_depth >= MIN_DEPTH
    if cache.gather != "caches" or cache.lobes != "split" or not deep or elements.num_elements == 0:
        return False
    ends = np.array([bool(lobe & LobeClass.DIFFUSE) and not lobe & _LONGER for lobe in table.lobes])
    return bool(ends[elements.shape].mean() >= MIN_SHARE)


def gather_params(diffuse: UnitRef, cache: CacheSettings) -> dict[str, Any]:
    """What the gathered radiance depends on, for keys."""
    return {"gather": [GATHER_VERSION, FILTER_VERSION], "diffuse": diffuse.key, "denoise": cache.denoise}


class DiffuseGather:
    """Diffuse caches of one scene in device memory.

    Args:
        mi_scene: the scene.
        table: its surfaces.
        elements: where the caches sit.
        diffuse: D of every element, float32 [n, 3].
    """

    def __init__(self, mi_scene: "mi.Scene", table: SurfaceTable, elements: ElementSet, diffuse: np.ndarray) -> None:
        nothing = np.zeros((0, 1, 1, 3), np.float32)
        self._shading = CacheShading(mi_scene, table, elements, CacheArrays(diffuse, nothing))
        self._table = table

    @classmethod
    def of_nothing(cls, mi_scene: "mi.Scene", table: SurfaceTable, elements: ElementSet) -> "DiffuseGather":
        """Black caches: for timing where none are baked yet."""
        return cls(mi_scene, table, elements, np.zeros((elements.num_elements, 3), np.float32))

    def radiance(self, pi, si, active) -> "tuple[mi.Color3f, mi.Bool]":
        """(rho_d D, whether it is known) where the rays of intersections `pi`, `si` end; 0 where it is not."""
        shape = self._table.shape_index(si, active)
        bits = dr.gather(mi.UInt32, self._table.lobe_bits_dr, shape, active)
        wanted = active & has(bits, LobeClass.DIFFUSE) & ((bits & _LONGER) == 0)
        points, weights = self._shading.locate(shape, pi, si, wanted)
        value, baked = self._shading.diffuse_radiance(points, weights, wanted)
        known = wanted & (baked > MIN_BAKED)
        rho = diffuse_reflectance(si.bsdf(), si, bits, LobeClass.DIFFUSE | LobeClass.MASKABLE, known)
        return dr.select(known, rho * value, 0.0), known


def load_diffuse(run: RunState, elements: ElementSet, ref: UnitRef) -> np.ndarray:
    """D of every element as the query uses it (denoised where the settings say so), float32 [n, 3].

    Raises:
        StorageError: a unit is missing or damaged.
    """
    cache, stored = run.settings.cache, CacheSet.open(run.store, ref)
    loaded = stored.load()
    diffuse = _of_every_element(elements, loaded["mean"])
    if cache.denoise:
        square = _of_every_element(elements, loaded["square"]).astype(np.float64)
        variance = np.maximum(square - diffuse.astype(np.float64) ** 2, 0.0) / max(stored.attributes["spp"] - 1, 1)
        diffuse = filter_diffuse(elements, diffuse, np.sqrt(variance))
    return diffuse


def _of_every_element(elements: ElementSet, rows: np.ndarray) -> np.ndarray:
    """Rows of the elements with a diffuse lobe among zeros for the others, float32 [n, 3]."""
    result = np.zeros((elements.num_elements, 3), np.float32)
    result[elements.diffuse] = rows
    return result


def diffuse_gather(run: RunState, elements: ElementSet, ref: UnitRef) -> DiffuseGather:
    """The gather over a sealed diffuse cache set; made once a run, black where there is no store.

    Raises:
        StorageError: the set is not sealed, a unit is missing or damaged.
    """
    if ref.key not in run.made:
        mi_scene, table = run.scene.mi_scene, run.table
        if run.store is None:
            run.made[ref.key] = DiffuseGather.of_nothing(mi_scene, table, elements)
        else:
            run.made[ref.key] = DiffuseGather(mi_scene, table, elements, load_diffuse(run, elements, ref))
    found: DiffuseGather = run.made[ref.key]
    return found
