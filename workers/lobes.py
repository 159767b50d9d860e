"""What a material does with light, and how its radiance is split into lobes that are cached apart.

The exitant radiance of a surface is written as (the split is exact for the light at a cache element)

    L_o(x, wo) = Le(x, wo) + rho_d(x, wo) * D(x) + t_s(x, wo) * S(x, wo) + delta chain

with D the irradiance over pi (one number: a Lambertian lobe has no direction), rho_d the diffuse reflectance at
the *pixel* (so texture never enters the cache), S the remaining non-delta lobe divided by its tint t_s, and
delta lobes followed by rays at query time.

Directions: Mitsuba's `si.wi` is the viewer (our wo) and its `wo` the light (our wi); the conversion is here.
"""

from enum import IntFlag

import numpy as np

from workers.backend import dr, mi

# The light direction at which a masked diffuse lobe is probed: 60 degrees, close to the mean of a cosine lobe.
PROBE_COSINE = 0.5
PROBE_SINE = float(np.sqrt(1 - PROBE_COSINE**2))
MIN_TINT = 0.02
TINT_SPREAD = 0.02  # a tint that changes less over a surface is left in the cache
TINT_PROBES = 1024
DIELECTRIC_F0 = 0.04  # what a coat adds to a stated diffuse reflectance
# First random numbers, of a sample's two, that pick a lobe or a blended material.
TINT_PICKS = tuple((pick + 0.5) / 8 for pick in range(8))


# Null: without it a `mask` material samples nothing but its hole; what hits the hole is dropped as delta.
DIRECTIONAL_MASK = int(mi.BSDFFlags.Glossy | mi.BSDFFlags.DiffuseTransmission | mi.BSDFFlags.Null)
SMOOTH_MASK = int(mi.BSDFFlags.Smooth | mi.BSDFFlags.Null)


class LobeClass(IntFlag):
    """Lobes of a material, as bits that travel into kernels."""

    DIFFUSE = 1  # has a diffuse reflection lobe: cached as one number
    GLOSSY = 2  # has a non-delta lobe besides: cached by direction
    DELTA = 4  # has mirror, ideal transmission or null lobes: followed at query time
    PRINCIPLED = 8  # a principled material: split by its parameters, it ignores component masks
    MASKABLE = 16  # honours `BSDFContext.type_mask`, so its lobes can be evaluated apart
    EMITTER = 32
    FRONT_ONLY = 64  # a principled material that is black from behind
    WHOLE = 128  # masks tear its diffuse lobe apart: the directional cache takes every non-delta lobe
    TINTED = 256  # its directionally cached lobe changes colour over the surface: the colour is divided out
    STATED = 512  # a `WHOLE` one that tells its diffuse reflectance, as principled ones under a normal map do
    PICKED = 1024  # a `TINTED` one whose samples depend on the number that picks the lobe, as those of blends do


def context(mask: int) -> "mi.BSDFContext":
    """A BSDF context restricted to some lobe types."""
    ctx = mi.BSDFContext()
    ctx.type_mask = mask
    return ctx


def classify_bsdf(bsdf: "mi.BSDF", *, is_emitter: bool = False) -> LobeClass:
    """Reads a material's flags and tests numerically whether its lobes can be evaluated apart."""
    flags = bsdf.flags()
    lobe = LobeClass.EMITTER if is_emitter else LobeClass(0)
    if mi.has_flag(flags, mi.BSDFFlags.Delta):
        lobe |= LobeClass.DELTA
    if mi.has_flag(flags, mi.BSDFFlags.DiffuseReflection):
        lobe |= LobeClass.DIFFUSE
    glossy = mi.has_flag(flags, mi.BSDFFlags.Glossy) or mi.has_flag(flags, mi.BSDFFlags.DiffuseTransmission)
    if glossy:
        lobe |= LobeClass.GLOSSY
    if bsdf.has_attribute("base_color") and bsdf.has_attribute("metallic"):
        return lobe | LobeClass.PRINCIPLED | (LobeClass(0) if _reflects_behind(bsdf) else LobeClass.FRONT_ONLY)
    if lobe & LobeClass.DIFFUSE and (not glossy or _is_maskable(bsdf)):
        lobe |= LobeClass.MASKABLE
    elif lobe & LobeClass.DIFFUSE:
        # A diffuse part that cannot be told apart from the rest is left in the directional lobe.
        lobe = lobe & ~LobeClass.DIFFUSE | LobeClass.GLOSSY | LobeClass.WHOLE
        if _states_reflectance(bsdf):
            lobe |= LobeClass.STATED
    if lobe & LobeClass.GLOSSY:
        lobe |= _tint_class(bsdf, lobe)
    return lobe


def _reflects_behind(bsdf: "mi.BSDF") -> bool:
    si = dr.zeros(mi.SurfaceInteraction3f, 1)
    si.wi = dr.normalize(mi.Vector3f(0.3, 0.2, -0.9))
    wo = dr.normalize(mi.Vector3f(-0.4, 0.2, -0.9))
    return bool(np.any(np.array(bsdf.eval(mi.BSDFContext(), si, wo)) > 0))


def _is_maskable(bsdf: "mi.BSDF") -> bool:
    si = dr.zeros(mi.SurfaceInteraction3f, 3)
    si.wi = dr.normalize(mi.Vector3f([0.3, -0.5, 0.1], [0.1, 0.4, 0.2], [0.9, 0.6, 0.9]))
    wo = dr.normalize(mi.Vector3f([-0.3, 0.4, -0.1], [-0.1, 0.2, -0.2], [0.9, 0.5, 0.9]))
    parts = [mi.BSDFFlags.Diffuse, mi.BSDFFlags.Glossy, mi.BSDFFlags.All]
    diffuse, glossy, everything = (np.array(bsdf.eval(context(part), si, wo)) for part in parts)
    separate = bool(np.any(np.abs(diffuse - everything) > 1e-4 * np.abs(everything) + 1e-9))
    return separate and bool(np.allclose(diffuse + glossy, everything, rtol=1e-3, atol=1e-6))


def _states_reflectance(bsdf: "mi.BSDF") -> bool:
    """Whether `eval_diffuse_reflectance` is the material's own, not Mitsuba's guess from one pair of directions."""
    si = _places(3)
    si.wi = dr.normalize(mi.Vector3f([0.0, 0.8, -0.3], [0.0, 0.1, 0.9], [1.0, 0.5, 0.2]))
    stated = np.array(bsdf.eval_diffuse_reflectance(si))
    return bool(np.isfinite(stated).all() and stated.max() <= 1.0 and np.allclose(stated, stated[:, :1], rtol=1e-4))


def _places(count: int) -> "mi.SurfaceInteraction3f":
    """Interactions at the origin of a plane, seen along its normal."""
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.n, si.dp_du, si.dp_dv = mi.Normal3f(0, 0, 1), mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.wi = mi.Vector3f(0, 0, 1)
    return si


def _tint_class(bsdf: "mi.BSDF", lobe: LobeClass) -> LobeClass:
    """`TINTED` where the tint differs between random places of the texture, and how it is to be sampled."""
    if not any(key.endswith("to_uv") for key in mi.traverse(bsdf).keys()):  # noqa: SIM118  # it yields pairs
        return LobeClass(0)
    rng = np.random.default_rng(0)
    si = _places(TINT_PROBES)
    si.uv = mi.Point2f(rng.random((2, TINT_PROBES), dtype=np.float32))
    found, pointer = LobeClass.TINTED, mi.BSDFPtr(bsdf)
    if not lobe & LobeClass.STATED and (lobe & LobeClass.WHOLE or _depends_on_pick(pointer, si)):
        found |= LobeClass.PICKED
    bits = dr.full(mi.UInt32, int(lobe | found), TINT_PROBES)
    tint = np.array(_sampled_tint(pointer, si, bits, lobe | found, mi.Bool(True)))
    return found if np.any(np.ptp(tint, axis=1) > TINT_SPREAD * tint.max()) else LobeClass(0)


def _depends_on_pick(bsdf: "mi.BSDFPtr", si: "mi.SurfaceInteraction3f") -> bool:
    glossy = context(DIRECTIONAL_MASK)
    weights = [np.array(bsdf.sample(glossy, si, mi.Float(pick), mi.Point2f(0.5))[1]) for pick in TINT_PICKS]
    return not all(np.allclose(weight, weights[0], rtol=1e-3, equal_nan=True) for weight in weights)


def has(bits: "mi.UInt32", lobe: LobeClass) -> "mi.Bool":
    """Mask of the lanes whose class has a lobe."""
    return (bits & int(lobe)) != 0


def diffuse_reflectance(
    bsdf: "mi.BSDFPtr",
    si: "mi.SurfaceInteraction3f",
    bits: "mi.UInt32",
    union: LobeClass,
    active: "mi.Bool",
) -> "mi.Color3f":
    """rho_d(x, wo): the factor that turns D into the radiance of the diffuse lobe.

    pi * f_d(wo, wi) with wi at 60 degrees in the plane of the viewer: exact for a Lambertian lobe, and with the
    viewer's Fresnel transmittance for coated ones. A principled material gives (1 - metallic) * base_color.
    """
    result = dr.zeros(mi.Color3f, dr.width(si))
    if union & LobeClass.MASKABLE:
        masked = active & has(bits, LobeClass.MASKABLE) & has(bits, LobeClass.DIFFUSE)
        side = dr.sign(si.wi.z)
        wi_light = mi.Vector3f(PROBE_SINE, 0.0, PROBE_COSINE * side)
        value = bsdf.eval(context(mi.BSDFFlags.Diffuse), si, wi_light, masked)
        result = dr.select(masked, value * (dr.pi / PROBE_COSINE), result)
    if union & LobeClass.PRINCIPLED:
        principled = active & has(bits, LobeClass.PRINCIPLED)
        base, metallic, transmission = principled_parameters(bsdf, si, principled)
        # Not in the mask above: with a narrower mask here, the same call in `specular_tint` read zeros where they
        # share a kernel (Mitsuba 3.9.1).
        reflects = (si.wi.z > 0) | ~has(bits, LobeClass.FRONT_ONLY)
        result = dr.select(principled & reflects, base * (1 - metallic) * (1 - transmission), result)
    return result


def principled_parameters(
    bsdf: "mi.BSDFPtr", si: "mi.SurfaceInteraction3f", active: "mi.Bool"
) -> "tuple[mi.Color3f, mi.Float, mi.Float]":
    """Base colour, metallic and specular transmission of principled materials (0 where absent)."""
    # Not as an attribute: grey bitmaps and checkerboards have none of three channels.
    base = bsdf.eval_diffuse_reflectance(si, active)
    metallic = bsdf.eval_attribute_1("metallic", si, active & bsdf.has_attribute("metallic", active))
    transmissive = active & bsdf.has_attribute("spec_trans", active)
    transmission = bsdf.eval_attribute_1("spec_trans", si, transmissive)
    return base, metallic, dr.select(transmissive, transmission, 0.0)


def specular_tint(
    bsdf: "mi.BSDFPtr",
    si: "mi.SurfaceInteraction3f",
    bits: "mi.UInt32",
    union: LobeClass,
    active: "mi.Bool",
) -> "mi.Color3f":
    """t_s(x, wo): the colour by which the directional lobe is divided in the cache; 1 where it has none.

    Schlick's Fresnel of a principled material (its metals take their colour from a texture); of another one whose
    colour changes over the surface, what it reflects of a viewer along the normal, or the diffuse reflectance that it
    states. The split is exact for any tint, as
    long as cache and pixel agree on it; a good one keeps textures out of the cache.
    """
    tint = dr.full(mi.Color3f, 1.0, dr.width(si))
    if union & LobeClass.TINTED:
        tinted = active & has(bits, LobeClass.TINTED)
        tint = dr.select(tinted, _sampled_tint(bsdf, si, bits, union, tinted), tint)
    if union & LobeClass.PRINCIPLED:
        principled = active & has(bits, LobeClass.PRINCIPLED)
        base, metallic, transmission = principled_parameters(bsdf, si, principled)
        f0 = dr.lerp(mi.Color3f(0.04), base, metallic)
        grazing = dr.power(1 - dr.minimum(dr.abs(si.wi.z), 1.0), 5)
        value = dr.maximum(f0 + (1 - f0) * grazing, MIN_TINT)
        value = dr.lerp(value, mi.Color3f(1.0), transmission)
        tint = dr.select(principled, value, tint)
    return tint


def _sampled_tint(
    bsdf: "mi.BSDFPtr", si: "mi.SurfaceInteraction3f", bits: "mi.UInt32", union: LobeClass, active: "mi.Bool"
) -> "mi.Color3f":
    """Weight of the lobe's middle sample for a viewer along the normal: its reflectance, whatever its roughness."""
    probe = mi.SurfaceInteraction3f(si)
    probe.wi = mi.Vector3f(0.0, 0.0, dr.select(si.wi.z < 0, -1.0, 1.0))
    middle = mi.Point2f(0.5)
    once = active & ~(has(bits, LobeClass.PICKED) | has(bits, LobeClass.STATED))
    _, weight = bsdf.sample(context(DIRECTIONAL_MASK), probe, mi.Float(0.5), middle, once)
    if union & LobeClass.STATED:
        stated = active & has(bits, LobeClass.STATED)
        weight = dr.select(stated, bsdf.eval_diffuse_reflectance(probe, stated) + DIELECTRIC_F0, weight)
    if union & LobeClass.PICKED:
        picked, total = active & has(bits, LobeClass.PICKED), dr.zeros(mi.Color3f, dr.width(si))
        whole = has(bits, LobeClass.WHOLE)
        for pick in TINT_PICKS:
            total += bsdf.sample(context(DIRECTIONAL_MASK), probe, mi.Float(pick), middle, picked & ~whole)[1]
            if union & LobeClass.WHOLE:
                total += bsdf.sample(context(SMOOTH_MASK), probe, mi.Float(pick), middle, picked & whole)[1]
        weight = dr.select(picked, total / len(TINT_PICKS), weight)
    return dr.clip(dr.select(dr.isfinite(weight), weight, 1.0), MIN_TINT, 1.0)


def shown_albedo(rho: "mi.Color3f", tint: "mi.Color3f", bits: "mi.UInt32", union: LobeClass) -> "mi.Color3f":
    """Albedo for the G-buffer: diffuse reflectance, and the tint of materials that show a texture by it."""
    if not union & LobeClass.TINTED:
        return rho
    return rho + dr.select(has(bits, LobeClass.TINTED), tint, 0.0)


def directional_lobes(
    si: "mi.SurfaceInteraction3f", bits: "mi.UInt32", union: LobeClass
) -> "tuple[mi.BSDFContext, mi.Color3f]":
    """Lobes left to the directional cache: those that are neither delta nor a maskable diffuse one.

    Returns:
        (context, reflectance of a Lambertian lobe to take away by value: a principled material ignores masks).
        Lanes of class `WHOLE` keep every non-delta lobe instead.
    """
    principled = has(bits, LobeClass.PRINCIPLED)
    removed = mi.Color3f(0.0)
    if union & LobeClass.PRINCIPLED:
        removed = diffuse_reflectance(si.bsdf(), si, bits, LobeClass.PRINCIPLED, principled)
    return context(DIRECTIONAL_MASK), removed


def reflectance_at(table, elements) -> np.ndarray:
    """rho_d at cache elements seen along their normal, float32 [n, 3] (to undo demodulation)."""
    si = table.interaction(elements.shape, elements.prim_local, elements.uv)
    sign = np.where(elements.side == 1, -1.0, 1.0).astype(np.float32)
    si.wi = mi.Vector3f(0.0, 0.0, mi.Float(sign))
    bits = dr.gather(mi.UInt32, table.lobe_bits_dr, mi.UInt32(elements.shape.astype(np.uint32)))
    rho = diffuse_reflectance(si.bsdf(), si, bits, table.lobe_union, mi.Bool(True))
    return np.ascontiguousarray(np.array(rho).T.astype(np.float32))
