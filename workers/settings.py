"""Every number that a run can choose, with presets; checked before any work starts."""

import dataclasses
import typing
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal, Self

from workers.errors import WorkerError
from workers.presets import PRESET_OVERRIDES
from workers.setting_values import RANGES, converted, out_of_range


class SettingsError(WorkerError, ValueError):
    """A setting has no such name or a value outside its range."""


@dataclass(frozen=True, kw_only=True)
class CacheSettings:
    """Where caches sit, what they hold and what they cost.

    Attributes:
        elements: "lattice" (section `workers/lattice.py`), "vertex" (mesh vertices) or "triangle" (the paper's
            barycentres).
        lobes: "split" (diffuse as one number, the rest by direction, delta followed) or "exitant" (the paper's:
            all of the exitant radiance by direction).
        demodulate: divide the diffuse lobe by the reflectance at the element.
        denoise: average neighbouring elements, guarded by their variance (`workers/cache_filter.py`).
        max_elements: budget of seen lattice elements; the lattice's spacing is solved from it.
        min_spacing_px: no finer than this many pixels of the domain's cameras.
        domain_poses: poses of the camera domain that decide what is seen.
        diffuse_spp: paths per element for the diffuse lobe; where caches are gathered from, a quarter of them to their
            end and half of them into those caches.
        grids: "adaptive" (each element gets the coarsest grid of 8x2, 16x4, 32x8, 64x16 and 128x32 that its
            lobe's width asks for) or "uniform" (azimuth x polar everywhere; always so where lobes is "exitant").
        azimuth, polar: directions per element of the directional lobe; with adaptive grids the finest one that
            is allowed (below 8x2 they are used as they are).
        gather: where paths meet a baked diffuse surface: "caches" (they take its radiance and end, `workers/gather.py`;
            never with paths of fewer than 8 segments or where hardly any surface is purely diffuse) or "paths" (they
            go on).
        directional_spp: paths per direction of the finest grid allowed; each coarser one doubles them, which
            halves the paths of an element.
        texels: the directional lobe at rest and in the query: "rgb9e5" (shared exponent, 4 bytes a texel, error at
            most 1/512 of its largest channel, 1/256 for principled materials) or "float32" (12 bytes at rest,
            16 in the query; always so where lobes is "exitant").
        passes: equal slices of a unit's samples; between them a bake reports and can be cancelled.
        elements_per_unit: cache elements in one unit of work (one chunk at rest).
        max_edge_fraction: paper tessellation, longest edge allowed as a share of the scene's diagonal ("triangle",
            "vertex"); 0 keeps the mesh.
    """

    elements: Literal["lattice", "vertex", "triangle"] = "lattice"
    lobes: Literal["split", "exitant"] = "split"
    demodulate: bool = True
    denoise: bool = True
    max_elements: int = 60_000
    min_spacing_px: float = 1.5
    domain_poses: int = 40
    diffuse_spp: int = 2048
    grids: Literal["uniform", "adaptive"] = "adaptive"
    azimuth: int = 64
    polar: int = 16
    directional_spp: int = 2
    gather: Literal["caches", "paths"] = "caches"
    texels: Literal["float32", "rgb9e5"] = "rgb9e5"
    passes: int = 1
    elements_per_unit: int = 256
    max_edge_fraction: float = 0.05


@dataclass(frozen=True, kw_only=True)
class QuerySettings:
    """How caches become an image.

    Attributes:
        samples: primary rays per pixel along each axis, 1 to 4.
        supersample: "edges" takes only the first of them where neighbouring pixels see one smooth surface
            (`workers/supersampling.py`), "everywhere" takes all of them.
        weights: "barycentric", or "paper" (three rays a pixel, W = Wd Wn + 0.01).
        scale_free: paper weights only: divide the distance by the primitive's size.
        max_chain: delta bounces followed at most.
    """

    samples: int = 2
    supersample: Literal["edges", "everywhere"] = "edges"
    weights: Literal["barycentric", "paper", "single"] = "barycentric"
    scale_free: bool = False
    max_chain: int = 8


@dataclass(frozen=True, kw_only=True)
class FrameSettings:
    """Which frames are rendered as ground truth, and how well.

    Attributes:
        num_train, num_validation, num_test: frames of path A (train and validation) and of path B.
        train_spp: paths per pixel of a training target.
        denoise_train: Open Image Denoise (high) over the training targets.
        test_spp: paths per pixel of a test reference.
        denoise_test: "never", "always", or "capped" (only where its own noise would cap scores; said so).
        passes: slices of a frame's samples.
    """

    num_train: int = 36
    num_validation: int = 4
    num_test: int = 6
    train_spp: int = 64
    denoise_train: bool = True
    test_spp: int = 1024
    denoise_test: Literal["never", "always", "capped"] = "capped"
    reference_floor_db: float = 40.0
    passes: int = 4


@dataclass(frozen=True, kw_only=True)
class TrainSettings:
    """Network and training.

    Attributes:
        widths: channels of the three scales.
        fusion: "fuse" (the paper's block) or "concatenate" (ablation).
        unshuffle: pixels folded into channels along each axis before the first layer (1: the paper).
        residual: the network corrects the imperfect radiance instead of replacing it.
        transfer: "mu_law" or "log1p" (the paper).
        l1_weight, perceptual_weight, gradient_weight: terms of the loss.
        perceptual_every: steps between two uses of the perceptual term (its weight grows alike).
        epochs: passes over the training frames; `seconds` ends training earlier when above 0. 0 trains nothing: the
            network then hands on the caches' radiance, and costs no time in a frame.
        batch: crops per step.
        crop: crop edge in pixels.
        schedule: "paper" (x 0.95 per epoch) or "cosine" (one cycle with warm-up).
        learning_rate: Adam's.
        clip_norm, clip_quantile: gradients are clipped to the smaller of `clip_norm` and this quantile of the norms of
            the last steps (1: never below what was).
        negative_slope: of the network's activation; 0 is ReLU.
        precision: of training and inference: "fp32", "bf16" or "auto" (measured).
    """

    widths: tuple[int, ...] = (16, 32, 48)
    fusion: Literal["fuse", "concatenate"] = "fuse"
    unshuffle: int = 2
    residual: bool = True
    transfer: Literal["mu_law", "log1p"] = "mu_law"
    l1_weight: float = 1.0
    perceptual_weight: float = 0.0
    gradient_weight: float = 0.0
    perceptual_every: int = 4
    epochs: int = 400
    seconds: float = 240.0
    batch: int = 4
    crop: int = 128
    schedule: Literal["paper", "cosine"] = "cosine"
    learning_rate: float = 2e-3
    clip_norm: float = 1.0
    clip_quantile: float = 0.5
    negative_slope: float = 0.2
    precision: Literal["fp32", "bf16", "auto"] = "auto"


@dataclass(frozen=True, kw_only=True)
class EvaluationSettings:
    """What is compared, and how often it is timed.

    Attributes:
        spp: path-traced adversaries.
        qualities: Open Image Denoise qualities tried on each of them.
        timing_repeats: timed frames per method, interleaved; the median counts.
        compile: try a compiled network (tens of seconds once a frame size) and keep it where it is faster.
    """

    spp: tuple[int, ...] = (1, 4, 16)
    qualities: tuple[str, ...] = ("fast", "balanced", "high")
    timing_repeats: int = 7
    compile: bool = True


@dataclass(frozen=True, kw_only=True)
class PlanSettings:
    """Who decides what a scene requires (`workers/planner.py`).

    Attributes:
        mode: "preset" (the preset's numbers as they are), "adaptive" (a plan of the scene replaces them before the
            first stage) or "applied" (it has).
        noise: relative standard error of each lobe over the frame, after the caches' filter, that the plan aims at.
        keep: settings that the plan must leave as they are, by dotted key.
    """

    mode: Literal["preset", "adaptive", "applied"] = "preset"
    noise: float = 0.04
    keep: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Settings:
    """All settings of a run."""

    preset: str = "balanced"
    width: int = 512
    height: int = 512
    cache: CacheSettings = field(default_factory=CacheSettings)
    query: QuerySettings = field(default_factory=QuerySettings)
    frames: FrameSettings = field(default_factory=FrameSettings)
    train: TrainSettings = field(default_factory=TrainSettings)
    evaluation: EvaluationSettings = field(default_factory=EvaluationSettings)
    plan: PlanSettings = field(default_factory=PlanSettings)

    @classmethod
    def preset_named(cls, name: str) -> "Settings":
        """Settings of a preset.

        Raises:
            SettingsError: no preset has that name.
        """
        if name not in PRESET_OVERRIDES:
            raise SettingsError(f"preset must be one of {', '.join(PRESET_OVERRIDES)}, got {name!r}")
        return Settings(preset=name).override(PRESET_OVERRIDES[name])

    def override(self, values: dict[str, Any]) -> Self:
        """A copy with dotted keys ("cache.diffuse_spp") set; strings are converted to the field's type.

        Raises:
            SettingsError: unknown key, a value that does not fit, or one outside its range (`setting_values.RANGES`).
        """
        result = self
        for key, value in values.items():
            result = _set(result, key.split("."), value, key)
        _check(result)
        return result

    def choose(self, values: dict[str, Any]) -> Self:
        """`override` by a person: a plan leaves these settings as they are.

        Raises:
            SettingsError: as `override`.
        """
        chosen = self.override(values)
        keep = {*chosen.plan.keep, *(key for key in values if "." in key and not key.startswith("plan."))}
        return chosen.override({"plan.keep": tuple(sorted(keep))})

    def to_json(self) -> dict[str, Any]:
        """Plain nested dict."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> "Settings":
        """Inverse of `to_json`; a field that is absent keeps its default.

        Raises:
            SettingsError: unknown key or a value that does not fit.
        """
        if not isinstance(value, dict):
            raise SettingsError(f"settings must be a mapping, got {type(value).__name__}")
        return cls().override(dict(_dotted(value)))


def _dotted(value: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, item in value.items():
        if isinstance(item, dict):
            yield from _dotted(item, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", item


PRESETS = tuple(PRESET_OVERRIDES)


def _set(node: Any, path: list[str], value: Any, key: str) -> Any:
    names = {f.name for f in dataclasses.fields(node)}
    name = path[0]
    if name not in names:
        raise SettingsError(f"setting {key!r} must name one of {', '.join(sorted(names))}, got {name!r}")
    current = getattr(node, name)
    if len(path) > 1:
        if not dataclasses.is_dataclass(current):
            raise SettingsError(f"setting {key!r} must not go below {name!r}, which is a single value")
        return dataclasses.replace(node, **{name: _set(current, path[1:], value, key)})
    if dataclasses.is_dataclass(current):
        raise SettingsError(f"setting {key!r} must name a single value; use {key}.<name>")
    kind = typing.get_type_hints(type(node))[name]
    try:
        return dataclasses.replace(node, **{name: converted(value, kind)})
    except ValueError as error:
        raise SettingsError(f"setting {key!r} must be {error}, got {value!r:.100}") from error


def _check(settings: Settings) -> None:
    for key in RANGES:
        value: Any = settings
        for name in key.split("."):
            value = getattr(value, name)
        rule = out_of_range(key, value)
        if rule is not None:
            raise SettingsError(f"setting {key!r} must be {rule}, got {value!r:.100}")
    if settings.query.weights != "barycentric" and settings.cache.lobes != "exitant":
        raise SettingsError(
            f"setting 'query.weights' must be barycentric unless cache.lobes is exitant, got {settings.query.weights}"
        )
    if settings.train.epochs == 0 and not settings.train.residual:
        raise SettingsError("setting 'train.epochs' must be above 0 unless train.residual is set, got 0")
    if settings.train.unshuffle not in (1, 2, 4):
        raise SettingsError(f"setting 'train.unshuffle' must be 1, 2 or 4, got {settings.train.unshuffle}")
    if len(settings.train.widths) != 3:
        raise SettingsError(f"setting 'train.widths' must be three channel counts, got {settings.train.widths}")
