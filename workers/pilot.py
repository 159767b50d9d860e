"""A pilot bake: how noisy a path is in each lobe, measured on a few elements, and how many paths that asks for.

Elements are drawn with the domain's hits as probability, in two strata (with a directional lobe and without), so that
means over them are means over pixels. With L the radiance that an element shows and s^2 the variance of one
path of a lobe as it is shown, the relative variance of the lobe over the frame is

    R = sum_i y_i^2 s_i^2 / max(L_i, L_floor)^2  /  sum_i y_i^2,       y_i = min(L_i / L_80, 1)^(1 / 2.2)

with y the display's value: relative noise e shows as e y / 2.2, so that R weighs noise as a tone-mapped picture does.
What is black is not shown, and costs nothing. n paths, averaged with those of P other elements, leave a relative
standard error of sqrt(R / (n P)); `LobeNoise.paths_for` inverts it.

Robust: an element's share is capped at a quantile of all of them, so that a firefly is one element's luck and not the
scene's demand. Deterministic: seeds derive from the scene, and paths are rounded up to powers of two.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from models.metrics import luminance
from workers.backend import dr, mi
from workers.bake_kernels import Batch, bake_diffuse, bake_directional, direction_in_bin
from workers.elements import ElementSet
from workers.gather import DiffuseGather, gathers
from workers.lobes import diffuse_reflectance, specular_tint
from workers.settings import CacheSettings
from workers.surfaces import SurfaceTable

# Part of the keys of what a plan decides; raise it whenever the same scene and settings give another pilot.
PILOT_VERSION = 2
NUM_PLAIN = 192
NUM_DIRECTIONAL = 96
DIFFUSE_SPP = 256
GRID = (8, 4)
DIRECTIONAL_SPP = 24
DISPLAY_GAMMA = 2.2
FLOOR = 0.02  # of the 80th percentile: what is darker shows no noise
CAP_QUANTILE = 0.95
NEAR_NORMAL = 0.9  # cosine above which an element's nearest one shares its light
EDGE_SHARE = 0.5  # of the difference of two neighbours: a linear interpolant is off by at most so much at a step


@dataclass(frozen=True, kw_only=True)
class LobeNoise:
    """Noise of one lobe over the frame.

    Attributes:
        relative_variance: R of the module's text, of one path.
        num_elements: sampled.
        share: of the domain's hits on elements with this lobe.
    """

    relative_variance: float
    num_elements: int
    share: float

    def standard_error(self, paths: float, pooled: float = 1.0) -> float:
        """Relative standard error over the frame with so many paths, averaged with those of so many neighbours."""
        return math.sqrt(self.relative_variance / (paths * pooled))

    def paths_for(self, target: float, pooled: float = 1.0) -> float:
        """Paths that leave a relative standard error of `target`; 0 where there is no noise."""
        return self.relative_variance / (target**2 * pooled)


@dataclass(frozen=True, kw_only=True)
class Pilot:
    """What a pilot bake found.

    Attributes:
        diffuse, directional: noise of the lobes; None where no element has one.
        display_power: mean of y^2, in [0, 1]; 0 for a black scene.
        interpolation_error: relative error between elements over the frame, from the differences of neighbours; an
            estimate that leans to the high side; 0 without a diffuse lobe.
        paths: that the pilot cost.
        samples: baked rows as they would be stored, by lobe; for the size of a store.
    """

    diffuse: LobeNoise | None
    directional: LobeNoise | None
    display_power: float
    interpolation_error: float
    paths: int
    samples: dict[str, list[np.ndarray]]

    def psnr(self, relative_error: float) -> float:
        """PSNR of the displayed frame, dB, if its only error were so large (relative, over the frame)."""
        shown = relative_error * math.sqrt(self.display_power) / DISPLAY_GAMMA
        return math.inf if shown <= 0 else -20 * math.log10(shown)


def ladder(paths: float, lowest: int, highest: int) -> int:
    """The power of two that is at least `paths`, within bounds: small changes of a measurement change no key."""
    wanted = 1 if paths <= 1 else 2 ** math.ceil(math.log2(paths) - 1e-9)
    return int(min(max(wanted, lowest), highest))


def run_pilot(
    mi_scene: "mi.Scene", table: SurfaceTable, elements: ElementSet, hits: np.ndarray, cache: CacheSettings,
    max_depth: int, seed: int,
) -> Pilot:  # fmt: skip
    """Bakes a few elements.

    Args:
        mi_scene: the scene.
        table: its surfaces.
        elements: of the scene.
        hits: the domain's hits that each element answers, [num_elements].
        cache: says which lobes are cached.
        max_depth: longest path.
        seed: of the choice of elements and of the paths.
    """
    if elements.num_elements == 0 or hits.sum() == 0:
        return Pilot(diffuse=None, directional=None, display_power=0.0, interpolation_error=0.0, paths=0, samples={})
    return _PilotBake(mi_scene, table, elements, hits, cache, max_depth, seed).run()


@dataclass
class _Stratum:
    """Pilot elements of one kind and what they show; [n, views] each, one view for those without a directional lobe.

    Attributes:
        share: of the domain's hits.
        shown: luminance of both lobes.
        diffuse, directional: variance of one path of each lobe, as shown (luminance squared).
        step: squared difference to the neighbour's diffuse lobe without its noise, as shown; may be below 0.
    """

    share: float
    shown: np.ndarray
    diffuse: np.ndarray
    directional: np.ndarray
    step: np.ndarray


class _PilotBake:
    """One pilot."""

    def __init__(self, mi_scene: "mi.Scene", table: SurfaceTable, elements: ElementSet, hits: np.ndarray,
                 cache: CacheSettings, max_depth: int, seed: int) -> None:  # fmt: skip
        self.scene, self.table, self.elements, self.hits = mi_scene, table, elements, hits
        self.cache, self.exitant, self.max_depth, self.seed = cache, cache.lobes == "exitant", max_depth, seed
        self.rng = np.random.default_rng(seed)
        self.paths = 0
        self.samples: dict[str, list[np.ndarray]] = {}
        self.known: list[tuple[np.ndarray, np.ndarray]] = []  # elements and their D

    def run(self) -> Pilot:
        every = np.arange(self.elements.num_elements)
        plain = np.setdiff1d(every, self.elements.glossy)
        total = int(self.hits.sum())
        strata = []
        for members, count, directional in ((plain, NUM_PLAIN, False), (self.elements.glossy, NUM_DIRECTIONAL, True)):
            seen = int(self.hits[members].sum())
            if seen:
                chosen = self.rng.choice(members, count, p=self.hits[members] / seen)
                strata.append(self._stratum(chosen, seen / total, directional=directional))
        return self._summed_up(strata, num_directional=NUM_DIRECTIONAL if self.hits[self.elements.glossy].sum() else 0)

    # ------------------------------------------------ baking -------------------------------------------------

    def _stratum(self, chosen: np.ndarray, share: float, *, directional: bool) -> _Stratum:
        rho, tint = self._colours(chosen, directional=directional)
        nothing: np.ndarray = np.zeros(rho.shape[:2])
        variance = step = specular = shown = nothing
        if not self.exitant:
            neighbour = self._neighbours(chosen)
            mean, error = self._diffuse(np.concatenate([chosen, neighbour]))
            n = len(chosen)
            shown = luminance(mean[:n, None] * rho)
            variance = _shown_variance(error[:n, None], rho)
            noise = _shown_variance(error[n:, None], rho) + variance
            step = luminance((mean[:n] - mean[n:])[:, None] * rho) ** 2 - noise / DIFFUSE_SPP
            step[neighbour == chosen] = 0.0
        if directional:
            mean, error = self._directional(chosen)
            light = luminance(mean * tint)
            specular = _shown_variance(error, tint)
            shown = shown + np.maximum(light, light.mean(axis=1, keepdims=True))
        return _Stratum(share, shown, variance, specular, step)

    def _batch(self, chosen: np.ndarray, purpose: int) -> Batch:
        count = len(chosen)
        seed = np.full(count, (self.seed + purpose) % 2**32, np.uint64)
        return Batch(chosen, seed, np.arange(count, dtype=np.uint64))

    def _diffuse(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(D, variance of one path of it), [n, 3]."""
        batch = self._batch(chosen, len(self.samples))
        mean, square = bake_diffuse(self.scene, self.table, self.elements, batch, DIFFUSE_SPP, 0, self.max_depth)
        self.paths += len(chosen) * DIFFUSE_SPP
        self.samples.setdefault("diffuse", []).extend([mean, square])
        mean, square = _finite(mean), _finite(square)
        self.known.append((chosen, mean))
        return mean, np.maximum(square - mean**2, 0.0) * DIFFUSE_SPP / (DIFFUSE_SPP - 1)

    def _directional(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(S, variance of one path of it), [n, views, 3]. Every path is an element of its own in the launch."""
        batch = self._batch(np.repeat(chosen, DIRECTIONAL_SPP), 1000)
        rows = bake_directional(
            self.scene, self.table, self.elements, batch, GRID, 1, 0, self.max_depth, self.exitant, self._gather()
        )  # fmt: skip
        self.paths += len(batch.element) * GRID[0] * GRID[1]
        paths = _finite(rows.reshape(len(chosen), DIRECTIONAL_SPP, -1, 3))
        mean = paths.mean(axis=1)
        self.samples["directional"] = [mean.reshape(len(chosen), GRID[1], GRID[0], 3).astype(np.float32)]
        return mean, paths.var(axis=1, ddof=1)

    def _gather(self) -> DiffuseGather | None:
        """Ends of paths as the bake will have them, with the pilot's own D: every element takes the nearest one's."""
        elements = self.elements
        if not gathers(self.cache, self.max_depth, self.table, elements):
            return None
        chosen, values = (np.concatenate(parts) for parts in zip(*self.known, strict=True))
        nearest = cKDTree(elements.position[chosen]).query(elements.position)[1]
        return DiffuseGather(self.scene, self.table, elements, values[nearest].astype(np.float32))

    def _colours(self, chosen: np.ndarray, *, directional: bool) -> tuple[np.ndarray, np.ndarray]:
        """(diffuse reflectance, tint of the directional lobe) by view, [n, views, 3]."""
        views = GRID[0] * GRID[1] if directional else 1
        if self.exitant:
            return np.zeros((len(chosen), views, 3)), np.ones((len(chosen), views, 3))
        elements = self.elements
        si = self.table.interaction(elements.shape[chosen], elements.prim_local[chosen], elements.uv[chosen])
        normal = mi.Vector3f(np.ascontiguousarray(elements.normal[chosen].T))
        bits = dr.gather(mi.UInt32, self.table.lobe_bits_dr, mi.UInt32(elements.shape[chosen].astype(np.uint32)))
        dr.eval(si, normal, bits)
        lane = dr.arange(mi.UInt32, len(chosen) * views)
        si, normal, bits = (dr.gather(type(value), value, lane // views) for value in (si, normal, bits))
        view = normal
        if directional:
            view = direction_in_bin(lane % views, GRID, mi.Point2f(0.5), normal)
        si.wi = si.to_local(view)
        union, active = self.table.lobe_union, mi.Bool(True)
        colours = (reads(si.bsdf(), si, bits, union, active) for reads in (diffuse_reflectance, specular_tint))
        rho, tint = (_finite(np.array(colour).T).reshape(len(chosen), views, 3) for colour in colours)
        return np.clip(rho, 0, 1), tint

    def _neighbours(self, chosen: np.ndarray) -> np.ndarray:
        """Nearest element of the same shape, side and about the same normal; the element itself where there is none."""
        elements = self.elements
        k = min(6, elements.num_elements)
        index = cKDTree(elements.position).query(elements.position[chosen], k=k)[1].reshape(len(chosen), k)
        same = (elements.shape[index] == elements.shape[chosen, None]) & (index != chosen[:, None])
        same &= elements.side[index] == elements.side[chosen, None]
        same &= np.einsum("nkc,nc->nk", elements.normal[index], elements.normal[chosen]) > NEAR_NORMAL
        first = same.argmax(axis=1)[:, None]
        return np.where(same.any(axis=1), np.take_along_axis(index, first, axis=1)[:, 0], chosen)

    # ----------------------------------------------- summing up ----------------------------------------------

    def _summed_up(self, strata: list[_Stratum], num_directional: int) -> Pilot:
        share = np.concatenate([np.full(s.shown.size, s.share / s.shown.size) for s in strata])
        shown = np.maximum(np.concatenate([s.shown.reshape(-1) for s in strata]), 0.0)
        bright = _weighted_quantile(shown, share, 0.8)
        if bright <= 0:
            bright = float(shown.max(initial=0.0))
        bright = bright if bright > 0 else 1.0  # a black scene: nothing is shown of any lobe
        floored = np.maximum(shown, FLOOR * bright)
        weight = share * np.minimum(shown / bright, 1.0) ** (2 / DISPLAY_GAMMA)
        power = float(weight.sum())

        def over_frame(name: str, *, robust: bool) -> float:
            relative = np.concatenate([getattr(s, name).reshape(-1) for s in strata]) / floored**2
            if robust and np.any(relative > 0):
                present = relative > 0
                relative = np.minimum(relative, _weighted_quantile(relative[present], share[present], CAP_QUANTILE))
            return max(float((weight * relative).sum() / power), 0.0) if power > 0 else 0.0

        sampled = sum(len(s.shown) for s in strata)
        has_diffuse = not self.exitant
        return Pilot(
            diffuse=LobeNoise(relative_variance=over_frame("diffuse", robust=True), num_elements=sampled, share=1.0)
            if has_diffuse else None,
            directional=LobeNoise(
                relative_variance=over_frame("directional", robust=True), num_elements=num_directional,
                share=sum(s.share for s in strata if s.shown.shape[1] > 1),
            ) if num_directional else None,
            display_power=power,
            interpolation_error=EDGE_SHARE * math.sqrt(over_frame("step", robust=False)) if has_diffuse else 0.0,
            paths=self.paths, samples=self.samples,
        )  # fmt: skip


def _shown_variance(variance: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """Variance of the luminance of colour * x, with the channels of x taken as fully correlated."""
    return luminance(np.sqrt(variance) * colour) ** 2


def _finite(values: np.ndarray) -> np.ndarray:
    """float64 with NaN and Inf as 0: the bake itself counts and refuses them, a pilot must only not follow them."""
    return np.nan_to_num(values.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)


def _weighted_quantile(values: np.ndarray, weight: np.ndarray, share: float) -> float:
    """The smallest value below which lies so much of the weight."""
    order = np.argsort(values, kind="stable")
    cumulative = np.cumsum(weight[order])
    return float(values[order[min(np.searchsorted(cumulative, share * cumulative[-1]), len(order) - 1)]])
