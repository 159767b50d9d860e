"""What a scene requires: decisions from its audit and a pilot bake, each with its reason.

A plan never changes where caches sit (elements follow from the scene, its cameras and the budget), so that it can be
made from the elements themselves. It lowers what is not needed and moves paths to the lobe that is noisier, but never
asks for more than `CEILING` times the given paths of a lobe.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from storage.keys import seed_from_key
from workers.audit import ElementAudit, SceneAudit, audit_elements, audit_scene
from workers.camera_path import domain_poses
from workers.domain_census import element_hits
from workers.element_stage import RAYS_PER_POSE, run_elements
from workers.elements import ElementSet, build_elements
from workers.pilot import PILOT_VERSION, LobeNoise, Pilot, ladder, run_pilot
from workers.plan import Choice
from workers.progress import Progress
from workers.run_state import PATH_SEED, RunState
from workers.settings import Settings
from workers.visibility import domain_hits

# Part of the keys of stored plans; raise it whenever the same scene and settings give other decisions.
PLANNER_VERSION = (1, PILOT_VERSION)
CENSUS_RAYS_PER_POSE = RAYS_PER_POSE // 4
CEILING = 2
LOWEST_DIFFUSE_SPP, LOWEST_DIRECTIONAL_SPP = 64, 1
# Elements whose paths a pixel averages, where `cache.denoise` filters them and where it does not (barycentric weights,
# and four bins of the grid): the effective number 1 / sum w^2 of `cache_filter`'s weights, measured on tiny and
# modern-hall (diffuse 25 and 33, directional 10 and 11, times two for the bins), rounded down.
POOLED = {"diffuse": (24.0, 2.0), "directional": (20.0, 4.0)}
GRIDS = ((16, 4), (32, 8), (64, 16))
GRID_QUANTILE = 0.1  # of the visible glossy surface may be sharper than its grid
GGX_HALF_WIDTH = 0.64  # tangent of GGX's half width at half maximum, of alpha
NO_NETWORK_DB = 40.0
SMALLEST_WIDTHS = (16, 16, 16)


@dataclass(frozen=True, kw_only=True)
class Decision:
    """What a scene requires.

    Attributes:
        audit, elements, pilot: what the choices rest on.
        overrides: settings to change, by dotted key; what a person set is not in it.
        choices: all choices, readable.
        network_needed: whether the caches alone are predicted to miss `NO_NETWORK_DB`.
        element_set: the elements themselves.
    """

    audit: SceneAudit
    elements: ElementAudit
    pilot: Pilot
    overrides: dict[str, Any]
    choices: tuple[Choice, ...]
    network_needed: bool
    element_set: ElementSet


def decide(run: RunState, progress: Progress | None = None) -> Decision:
    """Audits, bakes a pilot and decides; the same for the same scene and settings, whatever the store holds."""
    progress = progress or Progress()
    settings, table, mi_scene = run.settings, run.table, run.scene.mi_scene
    poses = domain_poses(run.paths, settings.cache.domain_poses, PATH_SEED)
    elements = _elements(run, poses, progress)
    progress.between_passes()
    audit = audit_scene(mi_scene, table, poses, CENSUS_RAYS_PER_POSE)
    hits = element_hits(elements, domain_hits(mi_scene, table, poses, settings.width, CENSUS_RAYS_PER_POSE, progress))
    progress.between_passes()
    seed = seed_from_key(run.scene.digest, "pilot")
    pilot = run_pilot(mi_scene, table, elements, hits, settings.cache, run.scene.max_depth, seed)
    return _Planner(settings, audit, audit_elements(table, elements, hits), pilot, elements).decision()


def _elements(run: RunState, poses: list, progress: Progress) -> ElementSet:
    """The run's elements: kept where there is a store, so that its first stage is done."""
    if run.store is not None:
        return run_elements(run)
    settings = run.settings
    hits = domain_hits(run.scene.mi_scene, run.table, poses, settings.width, RAYS_PER_POSE, progress)
    return build_elements(run.table, hits, settings.cache)


class _Planner:
    """Collects choices; what `plan.keep` names stays."""

    def __init__(self, settings: Settings, audit: SceneAudit, elements: ElementAudit, pilot: Pilot,
                 element_set: ElementSet) -> None:  # fmt: skip
        self.settings, self.audit, self.elements, self.pilot = settings, audit, elements, pilot
        self.element_set = element_set
        self.overrides: dict[str, Any] = {}
        self.choices: list[Choice] = []

    def decision(self) -> Decision:
        self._say_scene()
        self._say_elements()
        self._choose_grid()
        self._choose_spp()
        needed = self._choose_network()
        return Decision(audit=self.audit, elements=self.elements, pilot=self.pilot, overrides=self.overrides,
                        choices=tuple(self.choices), network_needed=needed, element_set=self.element_set)  # fmt: skip

    # ------------------------------------------------ choices -----------------------------------------------

    def _choose_grid(self) -> None:
        cache = self.settings.cache
        preset = (cache.azimuth, cache.polar)
        if not self.elements.num_directional:
            self._note("directions", "none", "no visible material has a directional lobe")
            return
        if cache.lobes == "exitant":
            self._note("directions", _by(preset), "the paper's caches hold all light by direction")
            return
        alpha = sharpest_alpha(self.audit)
        wanted = grid_for(alpha)
        grid = wanted if math.prod(wanted) <= math.prod(preset) else preset
        reason = (
            f"{100 * (1 - GRID_QUANTILE):.0f} % of the visible glossy surface is rougher than alpha {alpha:.2g}, "
            f"whose highlight asks for {_by(wanted)}" + ("; the preset's grid is the limit" if grid != wanted else "")
        )
        keys = ("cache.azimuth", "cache.polar")
        self._choose("directions", dict(zip(keys, grid, strict=True)), lambda v: f"{v[keys[0]]}x{v[keys[1]]}", reason)

    def _choose_spp(self) -> None:
        cache, target = self.settings.cache, self.settings.plan.noise
        lobes: tuple[tuple[str, LobeNoise | None, int, int], ...] = (
            ("diffuse", self.pilot.diffuse, cache.diffuse_spp, LOWEST_DIFFUSE_SPP),
            ("directional", self.pilot.directional, cache.directional_spp, LOWEST_DIRECTIONAL_SPP),
        )
        for lobe, noise, preset, lowest in lobes:
            unit = "paths an element" if lobe == "diffuse" else "paths a direction"
            if noise is None:
                self._note(f"{lobe} lobe", "none", "no visible material has one, or the pilot saw none")
                continue
            pooled = POOLED[lobe][0 if cache.denoise else 1]
            wanted = noise.paths_for(target, pooled)
            highest = CEILING * preset
            spp = ladder(wanted, min(lowest, preset), highest)
            left = 100 * noise.standard_error(spp, pooled)
            before = f"{100 * noise.standard_error(preset, pooled):.2g} % with {preset} as given"
            reason = f"pilot: {left:.2g} % relative noise (goal {100 * target:.2g} %), {before}"
            if wanted > highest:
                reason += f"; the goal asks for {wanted:.3g}, at most {CEILING} times the preset's are given"
            elif spp > wanted and spp == lowest:
                reason += f"; no fewer than {lowest}"
            key = f"cache.{lobe}_spp"
            self._choose(f"{lobe} lobe", {key: spp}, _shows(key, unit), reason)

    def _choose_network(self) -> bool:
        predicted, widths = self._predicted_db(), self.settings.train.widths
        directional = self.audit.share("glossy", "delta")
        shown = "beyond measure" if math.isinf(predicted) else f"{predicted:.1f} dB"
        if directional == 0 and predicted >= NO_NETWORK_DB and self.settings.cache.lobes == "split":
            reason = (
                f"purely diffuse, and the caches alone are predicted at {shown} (bound {NO_NETWORK_DB:.0f} dB): "
                "the frame needs no network but for what one sample a pixel leaves jagged; a run trains the smallest, "
                "with train.epochs=0 none"
            )
            values = {"train.widths": SMALLEST_WIDTHS}
            self._choose("network", values, lambda v: f"not needed; widths {v['train.widths']}", reason)
            return False
        cause = f"{100 * directional:.0f} % of what is seen is glossy or delta" if directional else (
            f"the caches alone are predicted at {shown}, below {NO_NETWORK_DB:.0f} dB")  # fmt: skip
        self._note("network", f"widths {widths}", cause, setting="train.widths")
        return True

    def _predicted_db(self) -> float:
        """PSNR of the caches alone: noise that is left, and interpolation between elements."""
        cache, squared = self.settings.cache, self.pilot.interpolation_error**2
        for lobe, noise in (("diffuse", self.pilot.diffuse), ("directional", self.pilot.directional)):
            if noise is not None:
                spp = self.overrides.get(f"cache.{lobe}_spp", getattr(cache, f"{lobe}_spp"))
                squared += noise.standard_error(spp, POOLED[lobe][0 if cache.denoise else 1]) ** 2
        return self.pilot.psnr(math.sqrt(squared))

    # ------------------------------------------------- facts ------------------------------------------------

    def _say_scene(self) -> None:
        audit = self.audit
        self._note("surfaces", f"{audit.num_shapes} shapes, {audit.num_primitives} primitives",
                   f"{len(audit.materials)} materials; {100 * audit.hit_share:.0f} % of the rays hit them")  # fmt: skip
        kinds = ("diffuse", "glossy", "delta", "transmissive", "cutout", "emissive")
        shares = [f"{kind} {100 * audit.share(kind):.3g} %" for kind in kinds if audit.share(kind) > 0]
        sharp = [m.facts.roughness.low for m in audit.materials if m.facts.roughness and m.visibility > 0]
        self._note("materials seen", ", ".join(shares) or "nothing",
                   f"alpha from {min(sharp):.2g} to {max(sharp):.2g}" if sharp else "no rough lobe")  # fmt: skip
        textured = sum(m.visibility for m in audit.materials if m.facts.textured)
        self._note("textures", f"on {100 * textured:.3g} % of what is seen", "read at the pixel: none is cached")
        delta, followed = audit.share("delta"), f"followed, at most {self.settings.query.max_chain} bounces"
        self._note("delta surfaces", followed if delta else "none seen",
                   f"{100 * delta:.3g} % of what is seen; they have no lobe to cache")  # fmt: skip
        varying = [name for name, spread in audit.channels.items() if spread and spread.varies]
        still = [name for name in audit.channels if name not in varying]
        self._note("G-buffer channels", ", ".join(varying) or "none vary",
                   f"{', '.join(still)} constant over the domain: the network learns nothing from it" if still
                   else "all of them vary over the domain")  # fmt: skip
        self._note("motion", ", ".join(audit.moving) or "none", "static scene: one bake serves every pose")
        self._note("reconstructor", "cache", "static scene, any pose, all light paths")

    def _say_elements(self) -> None:
        elements, cache = self.elements, self.settings.cache
        at_limit = elements.num_elements > 0.9 * cache.max_elements
        spacing = self.element_set.spacing_px
        self._note("elements", f"{elements.num_elements} ({cache.elements})",
                   f"seen from {cache.domain_poses} poses"
                   + (f", {spacing:.2g} px apart" if spacing else "")
                   + (f"; the budget of {cache.max_elements} decides" if at_limit else "; fewer than the budget"),
                   setting="cache.max_elements")  # fmt: skip
        level = self.element_set.patches.patch_level
        cut = int((self.element_set.patches.prim_patches > 1).sum())
        self._note("tessellation", f"{cut} primitives cut, lattices of level {int(level.max(initial=0))} at most",
                   "large on screen; geometry itself is not touched")  # fmt: skip
        self._note("sides", f"{elements.num_elements - elements.num_back} front, {elements.num_back} back",
                   "only sides that a camera of the domain sees")  # fmt: skip

    # ----------------------------------------------- recording ----------------------------------------------

    def _note(self, item: str, choice: str, reason: str, setting: str = "") -> None:
        kept = setting in self.settings.plan.keep
        self.choices.append(Choice(
            item=item, choice=choice, reason=f"set by you; {reason}" if kept else reason,
            settings=(setting,) if setting else (), by="you" if kept else "plan",
        ))  # fmt: skip

    def _choose(self, item: str, values: dict[str, Any], show: Callable[[dict[str, Any]], str], reason: str) -> None:
        """Takes the planned values of some settings, but for those that a person set."""
        present = {key: setting_of(self.settings, key) for key in values}
        kept = [key for key in values if key in self.settings.plan.keep]
        chosen = {key: present[key] if kept else value for key, value in values.items()}
        if kept:
            reason = f"set by you ({', '.join(kept)}); the plan would take {show(values)}: {reason}"
        self.overrides |= {key: value for key, value in chosen.items() if value != present[key]}
        self.choices.append(
            Choice(item=item, choice=show(chosen), reason=reason, settings=tuple(values), by="you" if kept else "plan")
        )


def setting_of(settings: Settings, key: str) -> Any:
    """The value of a dotted key."""
    value: Any = settings
    for name in key.split("."):
        value = getattr(value, name)
    return value


def sharpest_alpha(audit: SceneAudit) -> float:
    """Alpha below which at most `GRID_QUANTILE` of the visible glossy surface lies; 1 without any."""
    glossy = [m for m in audit.materials if m.facts.roughness is not None and m.visibility > 0]
    if not glossy:
        return 1.0
    alphas = np.array([m.facts.roughness.low for m in glossy if m.facts.roughness is not None])
    weight = np.array([m.visibility for m in glossy])
    order = np.argsort(alphas, kind="stable")
    share = np.cumsum(weight[order]) / weight.sum()
    return float(alphas[order][np.searchsorted(share, GRID_QUANTILE, side="right").clip(max=len(order) - 1)])


def grid_for(alpha: float) -> tuple[int, int]:
    """Smallest of `GRIDS` with two bins of polar angle or more in the full width of a reflected highlight.

    Mirroring doubles the angle of the half vector: the highlight of GGX is 4 atan(0.64 alpha) wide. Where elements
    choose grids of their own, this is the largest of them.
    """
    bins = (math.pi / 2) / max(2 * math.atan(GGX_HALF_WIDTH * alpha), 1e-9)
    return next((grid for grid in GRIDS if grid[1] >= bins), GRIDS[-1])


def _by(grid: tuple[int, int]) -> str:
    return f"{grid[0]}x{grid[1]}"


def _shows(key: str, unit: str) -> Callable[[dict[str, Any]], str]:
    return lambda values: f"{values[key]} {unit}"
