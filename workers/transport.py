"""Path tracing from a surface point, as Dr.Jit programs.

The loop is unidirectional path tracing with next-event estimation and the power heuristic (Veach 1997, ch. 9 and
10), the estimator of Mitsuba's `path` integrator, so that caches and ground truth converge to the same values:
Russian roulette from `RR_DEPTH` on, paths of at most `max_depth` segments.

Symbols: `beta` throughput, `eta` product of relative refractive indices (for roulette), `L` radiance gathered.
Mitsuba's `si.wi` points to the viewer, its `wo` to the light.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from workers.backend import dr, mi
from workers.lobes import SMOOTH_MASK, context
from workers.sequences import PaddedPoints

if TYPE_CHECKING:
    from workers.gather import DiffuseGather

RR_DEPTH = 5
# Mitsuba's own 0.95 has infinite variance in a closed box of albedo 0.99: a bounce multiplies the mean of the squared
# weight by albedo^2 / survival, which must stay below 1.
RR_MAX_SURVIVAL = 0.99
TRANSPORT_VERSION = 5  # part of the keys of what is baked; raise it whenever the estimator gives other values
UNLIMITED_DEPTH = 0xFFFFFFFF


@dataclass
class PathStart:
    """The segment that leaves the first vertex.

    Attributes:
        ray: from the first vertex into the scene.
        beta: its weight (f cos / pdf of the first vertex).
        vertex: the first vertex, for the emitter's pdf.
        pdf: solid-angle density of the ray's direction.
        is_delta: whether the direction came from a delta lobe (no next-event estimate competes with it).
        eta: relative index gathered so far.
        active: lanes that go on.
    """

    ray: "mi.Ray3f"
    beta: "mi.Color3f"
    vertex: "mi.SurfaceInteraction3f"
    pdf: "mi.Float"
    is_delta: "mi.Bool"
    eta: "mi.Float"
    active: "mi.Bool"


def power_heuristic(pdf_a: "mi.Float", pdf_b: "mi.Float") -> "mi.Float":
    """Weight of the technique with density `pdf_a` against the one with `pdf_b` (beta = 2)."""
    # By their ratio: the squares of a tiny light's density overflow, those of a huge light's underflow to 0 / 0.
    return dr.select(pdf_a > 0, dr.rcp(1 + dr.square(pdf_b / pdf_a)), 0.0)


@dr.syntax
def incident_radiance(
    scene: "mi.Scene", start: PathStart, rng: "mi.PCG32", max_depth: int, gather: "DiffuseGather | None" = None
) -> "mi.Color3f":
    """Estimates `beta * L_i` along `start.ray`; one sample a lane.

    Args:
        scene: the scene.
        start: first segment; it counts as segment 1 after the cached vertex, so a light it meets is seen at depth 1.
        rng: random numbers, one stream a lane; advanced.
        max_depth: longest path, counted as Mitsuba's `path` counts from a camera that looks at the first vertex:
            the emission found by `start.ray` needs max_depth >= 2. Negative: unlimited.
        gather: knows the radiance of some diffuse surfaces; a path that meets one takes it and ends.

    Returns:
        Color3f, linear radiance times `start.beta`.
    """
    limit = UNLIMITED_DEPTH if max_depth < 0 else max(max_depth - 1, 0)
    ctx = mi.BSDFContext()

    ray = mi.Ray3f(start.ray)
    beta = mi.Color3f(start.beta)
    L = dr.zeros(mi.Color3f, dr.width(beta))
    eta = mi.Float(start.eta)
    previous = dr.zeros(mi.Interaction3f, dr.width(beta))
    previous.p = start.vertex.p
    previous_pdf = mi.Float(start.pdf)
    previous_delta = mi.Bool(start.is_delta)
    depth = mi.UInt32(0)
    active = mi.Bool(start.active) & (limit > 0)

    while active:
        pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)

        # ---------------------- Emission met by the sampled direction ----------------------
        emitter = si.emitter(scene)
        ds = mi.DirectionSample3f(scene, si, previous)
        emitter_pdf = scene.pdf_emitter_direction(previous, ds, ~previous_delta & (emitter != None))  # noqa: E711
        weight = dr.select(previous_delta, 1.0, power_heuristic(previous_pdf, emitter_pdf))
        L += dr.select(active, beta * weight * emitter.eval(si, active), 0.0)

        goes_on = active & (depth + 1 < limit) & si.is_valid()
        bsdf = si.bsdf(ray)

        # ------------------------- Radiance that caches know already -----------------------
        if dr.hint(gather is not None, mode="scalar"):
            assert gather is not None
            cached, known = gather.radiance(pi, si, goes_on)
            L += beta * cached
            goes_on &= ~known

        # ------------------------------ Next-event estimation ------------------------------
        nee = goes_on & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        ds, radiance = scene.sample_emitter_direction(si, mi.Point2f(rng.next_float32(), rng.next_float32()), True, nee)
        nee &= ds.pdf != 0.0
        wo = si.to_local(ds.d)

        sample_1 = rng.next_float32()
        sample_2 = mi.Point2f(rng.next_float32(), rng.next_float32())
        value, pdf, bs, bsdf_weight = bsdf.eval_pdf_sample(ctx, si, wo, sample_1, sample_2, goes_on)
        competing = dr.select(ds.delta, 1.0, power_heuristic(ds.pdf, pdf))
        L += dr.select(nee, beta * value * radiance * competing, 0.0)

        # ------------------------------- Next segment --------------------------------------
        ray = si.spawn_ray(si.to_world(bs.wo))
        beta *= bsdf_weight
        eta *= bs.eta
        previous.p = si.p
        previous_pdf = bs.pdf
        previous_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)

        # ------------------------------- Russian roulette ----------------------------------
        depth += 1
        largest = dr.max(beta) * dr.square(eta)
        survival = dr.minimum(largest, RR_MAX_SURVIVAL)
        roulette = depth + 1 >= RR_DEPTH
        alive = ~roulette | (rng.next_float32() < survival)
        beta[roulette] *= dr.rcp(dr.maximum(survival, 1e-8))
        active = goes_on & alive & (dr.max(beta) != 0.0)

    return L


def lambertian_start(
    scene: "mi.Scene", si: "mi.SurfaceInteraction3f", normal: "mi.Vector3f", points: PaddedPoints
) -> tuple["mi.Color3f", PathStart]:  # fmt: skip
    """First vertex with a white Lambertian lobe: next-event estimate of E / pi, and the path's start.

    Args:
        scene: the scene.
        si: the cached point.
        normal: unit normal of the cached side.
        points: of light and direction; advanced.
    """
    frame = mi.Frame3f(normal)
    ds, radiance = scene.sample_emitter_direction(si, points.next_2d(), True, mi.Bool(True))
    cosine = dr.maximum(dr.dot(ds.d, normal), 0.0)
    lit = (ds.pdf != 0.0) & (cosine > 0.0)
    weight = dr.select(ds.delta, 1.0, power_heuristic(ds.pdf, cosine * dr.inv_pi))
    direct = dr.select(lit, radiance * (cosine * dr.inv_pi * weight), 0.0)

    local = mi.warp.square_to_cosine_hemisphere(points.next_2d())
    direction = frame.to_world(local)
    start = PathStart(
        ray=si.spawn_ray(direction),
        beta=dr.full(mi.Color3f, 1.0, dr.width(normal)),
        vertex=si,
        pdf=mi.warp.square_to_cosine_hemisphere_pdf(local),
        is_delta=mi.Bool(False),
        eta=mi.Float(1.0),
        active=local.z > 0.0,
    )
    return direct, start


def exitant_start(
    scene: "mi.Scene", si: "mi.SurfaceInteraction3f", lobes: "CachedLobes", points: PaddedPoints
) -> tuple["mi.Color3f", PathStart]:  # fmt: skip
    """First vertex with the cached lobes of its own material, seen from `si.wi`.

    Args:
        scene: the scene.
        si: the cached point; `si.wi` is the local direction to the viewer.
        lobes: which part of the material is cached.
        points: of light, lobe and direction; advanced.
    """
    bsdf = si.bsdf()
    ds, radiance = scene.sample_emitter_direction(si, points.next_2d(), True, mi.Bool(True))
    wo = si.to_local(ds.d)
    sample_1, sample_2 = points.next_1d(), points.next_2d()
    value, pdf, bs, weight = bsdf.eval_pdf_sample(lobes.ctx, si, wo, sample_1, sample_2, mi.Bool(True))
    if lobes.whole is not None:
        smooth = context(SMOOTH_MASK)
        every = bsdf.eval_pdf_sample(smooth, si, wo, sample_1, sample_2, lobes.whole)
        partial = (value, pdf, bs, weight)
        value, pdf, bs, weight = (dr.select(lobes.whole, a, b) for a, b in zip(every, partial, strict=True))
    value -= lobes.lambertian * dr.maximum(wo.z * dr.sign(si.wi.z), 0.0) * dr.inv_pi
    lit = ds.pdf != 0.0
    competing = dr.select(ds.delta, 1.0, power_heuristic(ds.pdf, pdf))
    direct = dr.select(lit, value * radiance * competing, 0.0)

    is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    cosine = dr.maximum(bs.wo.z * dr.sign(si.wi.z), 0.0)
    removed = lobes.lambertian * cosine * dr.inv_pi
    weight -= dr.select(is_delta | (bs.pdf <= 0.0), 0.0, removed / bs.pdf)
    goes_on = (bs.pdf > 0.0) & (mi.Bool(lobes.with_delta) | ~is_delta)
    start = PathStart(
        ray=si.spawn_ray(si.to_world(bs.wo)),
        beta=dr.select(goes_on, weight, 0.0),
        vertex=si,
        pdf=bs.pdf,
        is_delta=is_delta,
        eta=bs.eta,
        active=goes_on & (dr.max(dr.abs(weight)) > 0.0),
    )
    return direct, start


@dataclass
class CachedLobes:
    """The part of a material whose exitant radiance is cached.

    Attributes:
        ctx: BSDF context that selects lobes.
        lambertian: reflectance of a Lambertian lobe to take away (cached apart); 0 where nothing is.
        with_delta: whether delta lobes belong to the cache (paper-exact) or are followed at query time.
        whole: lanes whose every non-delta lobe is cached, whatever `ctx` says; None where there are none.
    """

    ctx: "mi.BSDFContext"
    lambertian: "mi.Color3f"
    with_delta: bool
    whole: "mi.Bool | None" = None
