"""What one material is, read from Mitsuba's flags and parameters, and measured where it states nothing.

Roughness is GGX's or Beckmann's alpha (a principled material states its square root). Where a material has a
glossy lobe but no such parameter (tabulated ones, textures of mesh attributes), GGX's alpha is measured from samples
of the lobe, seen along the normal. There tan^2 of the half vector's angle is below t with probability
t / (t + alpha^2); reflected samples are those with t < 1, so that their median is m = alpha^2 / (1 + 2 alpha^2) and
alpha^2 = m / (1 - 2 m). Beckmann's lobes measure up to a sixth smaller.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from workers.backend import dr, mi
from workers.lobes import context

ALPHA_NAMES = ("alpha", "alpha_u", "alpha_v", "roughness")
MEASURED_SAMPLES = 4096
LARGEST_MEDIAN = 1 / 3  # alpha 1
_NESTED = re.compile(r"=\s*(\w+)\[")
_COLOURS = ("color0", "color1")
_NOT_A_VALUE = ("to_uv", "scale", "offset")

Kind = Literal["diffuse", "glossy", "delta", "transmissive", "cutout", "emissive"]


@dataclass(frozen=True, kw_only=True)
class Roughness:
    """Alpha of a material's glossy lobe.

    Attributes:
        mean, low, high: over its parameters and their texels; anisotropic ones are thrown together.
        source: "parameter", "texture", or "measured" from samples.
    """

    mean: float
    low: float
    high: float
    source: Literal["parameter", "texture", "measured"]


@dataclass(frozen=True, kw_only=True)
class MaterialFacts:
    """One material, whatever surfaces it lies on.

    Attributes:
        plugin: Mitsuba's class, with the nested one of a two-sided material.
        kinds: what it does with light, in the order of `Kind`; empty for one that is black.
        roughness: of its glossy lobe; None without one.
        textured: parameters that vary over the surface.
        two_sided: whether both sides reflect.
    """

    plugin: str
    kinds: tuple[Kind, ...]
    roughness: Roughness | None
    textured: tuple[str, ...]
    two_sided: bool


def material_facts(
    bsdf: "mi.BSDF", *, is_emitter: bool = False, places: "mi.SurfaceInteraction3f | None" = None
) -> MaterialFacts:
    """Reads a material; `places` as `measured_alpha` takes them."""
    parameters = mi.traverse(bsdf)
    textured = tuple(sorted(set(_varying(parameters))))
    if not textured and mi.has_flag(bsdf.flags(), mi.BSDFFlags.SpatiallyVarying):
        textured = ("unnamed",)
    kinds = _kinds(bsdf, is_emitter)
    return MaterialFacts(
        plugin=_plugin(bsdf, parameters),
        kinds=kinds,
        roughness=_roughness(bsdf, parameters, textured, places) if "glossy" in kinds else None,
        textured=textured,
        two_sided=_is_two_sided(bsdf),
    )


def _kinds(bsdf: "mi.BSDF", is_emitter: bool) -> tuple[Kind, ...]:
    flags, names = bsdf.flags(), mi.BSDFFlags
    through = (names.DiffuseTransmission, names.GlossyTransmission, names.DeltaTransmission)
    thin = mi.has_flag(flags, names.Null) and mi.has_flag(
        flags, names.DeltaReflection
    )  # a pane: light goes straight on
    found: dict[Kind, bool] = {
        "diffuse": mi.has_flag(flags, names.DiffuseReflection) or mi.has_flag(flags, names.DiffuseTransmission),
        "glossy": mi.has_flag(flags, names.GlossyReflection) or mi.has_flag(flags, names.GlossyTransmission),
        "delta": mi.has_flag(flags, names.DeltaReflection) or mi.has_flag(flags, names.DeltaTransmission),
        "transmissive": any(mi.has_flag(flags, flag) for flag in through) or thin,
        "cutout": mi.has_flag(flags, names.Null) and not thin,
        "emissive": is_emitter,
    }
    return tuple(kind for kind, present in found.items() if present)


def _is_two_sided(bsdf: "mi.BSDF") -> bool:
    components = [bsdf.flags(index) for index in range(bsdf.component_count())]
    return any(
        mi.has_flag(flags, mi.BSDFFlags.BackSide) and not mi.has_flag(flags, mi.BSDFFlags.Null) for flags in components
    )


def _plugin(bsdf: "mi.BSDF", parameters: Any) -> str:
    """The class name; that of a two-sided wrapper says nothing, so the nested one's is given."""
    name = bsdf.class_name()
    if name != "TwoSidedBRDF":
        return name
    if any(str(key).endswith(".metallic.value") for key in parameters.keys()):  # noqa: SIM118  # no mapping
        return "Principled"  # prints no name of its own
    nested = _NESTED.search(str(bsdf))
    return nested[1] if nested else name


def _varying(parameters: Any) -> Iterator[str]:
    """Parameters that hold more than one number for the whole surface.

    A uniform texture shows a leaf `value`; a bitmap `data`, a checkerboard `color0` and `color1`, and all of them
    their place in texture space. A texture of mesh attributes shows nothing.
    """
    for key in parameters.keys():  # noqa: SIM118  # no mapping
        *folders, leaf = str(key).split(".")
        named = [part for part in folders if part not in _COLOURS]
        if named and (leaf in ("data", "to_uv") or len(named) < len(folders)):
            yield named[-1]


def _roughness(
    bsdf: "mi.BSDF", parameters: Any, textured: tuple[str, ...], places: "mi.SurfaceInteraction3f | None"
) -> Roughness:
    values, from_texture = _stated_alpha(parameters)
    if len(values) and "unnamed" not in textured:
        source: Literal["texture", "parameter"] = "texture" if from_texture else "parameter"
        return _spread(values, source)
    return _spread(measured_alpha(bsdf, places), "measured")


def _spread(values: np.ndarray, source: Literal["parameter", "texture", "measured"]) -> Roughness:
    clean = values[np.isfinite(values)]
    if not len(clean):
        return Roughness(mean=1.0, low=1.0, high=1.0, source=source)
    return Roughness(mean=float(clean.mean()), low=float(clean.min()), high=float(clean.max()), source=source)


def _stated_alpha(parameters: Mapping[str, Any]) -> tuple[np.ndarray, bool]:
    """(alpha of every number that states one, whether a texture does)."""
    found, from_texture = [], False
    for key in parameters.keys():  # noqa: SIM118  # no mapping
        parts = str(key).split(".")
        name = next((part for part in parts if part in ALPHA_NAMES), None)
        if name is None or parts[-1] in _NOT_A_VALUE:
            continue
        stored = np.array(parameters[key]).reshape(-1)
        whole = np.issubdtype(stored.dtype, np.integer)  # texels that are kept as they lie in the file
        numbers = stored.astype(np.float64) / (np.iinfo(stored.dtype).max if whole else 1)
        from_texture |= len(numbers) > 1 or parts[-1] == "data" or bool(set(_COLOURS) & set(parts))
        found.append(np.square(numbers) if name == "roughness" else numbers)
    return (np.concatenate(found) if found else np.zeros(0)), from_texture


def measured_alpha(bsdf: "mi.BSDF", places: "mi.SurfaceInteraction3f | None" = None) -> np.ndarray:
    """GGX's alpha of the reflecting glossy lobe from samples of it, one number; empty where it cannot be sampled alone.

    Args:
        bsdf: the material.
        places: of a surface that wears it, `MEASURED_SAMPLES` of them; default: a plane, all of the texture.
    """
    rng = mi.PCG32(MEASURED_SAMPLES)
    if places is None:
        si = dr.zeros(mi.SurfaceInteraction3f, MEASURED_SAMPLES)
        si.t, si.n, si.sh_frame = 1.0, mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Vector3f(0, 0, 1))
        si.uv = mi.Point2f(rng.next_float32(), rng.next_float32())
    else:
        si = places
    si.wi = mi.Vector3f(0.0, 0.0, 1.0)
    which, place = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
    sample, weight = bsdf.sample(context(int(mi.BSDFFlags.Glossy)), si, which, place)
    kept = (sample.pdf > 0) & (dr.max(weight) > 0) & (sample.wo.z > 0)
    half = dr.normalize(si.wi + sample.wo)
    squared = (1 - dr.square(half.z)) / dr.maximum(dr.square(half.z), 1e-9)
    values = squared.numpy()[kept.numpy().astype(bool)]
    if not len(values):
        return np.zeros(0)
    median = min(float(np.median(values)), LARGEST_MEDIAN)
    return np.array([np.sqrt(median / (1 - 2 * median))])
