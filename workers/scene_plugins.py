"""The Mitsuba plugins that a scene may name, for whoever must decide before Mitsuba sees it.

Mitsuba turns a plugin's name into the path of a shared library, so a name that nobody has looked at is code
that nobody has looked at. `tests/workers/test_scene_plugins.py` builds everything in `PLUGINS` through `load_scene`.
What is left out is in `REFUSED_PLUGINS` with its reason (instances of a file that its owner names are
written out, `workers/scene_instances.py`); the same test holds that the two together are all that the
installed Mitsuba has.
"""


def _names(text: str) -> frozenset[str]:
    return frozenset(text.split())


PLUGINS: dict[str, frozenset[str]] = {
    "bsdf": _names(
        "blendbsdf bumpmap circular conductor dielectric diffuse hair mask measured normalmap null plastic "
        "polarizer pplastic principled principledthin retarder roughconductor roughdielectric roughplastic "
        "thindielectric twosided"
    ),
    "emitter": _names("area constant directional directionalarea envmap point projector spot sunsky timed_sunsky"),
    "shape": _names("cube cylinder disk ellipsoidsmesh merge obj ply rectangle serialized sphere"),
    "texture": _names(
        "bitmap blackbody checkerboard d65 irregular mesh_attribute rawconstant regular srgb uniform volume"
    ),
    "volume": frozenset({"constvolume", "gridvolume"}),
    "medium": frozenset({"heterogeneous", "homogeneous"}),
    "phase": _names("blendphase hg isotropic rayleigh sggx tabphase"),
    "sensor": _names("batch distant irradiancemeter orthographic perspective radiancemeter thinlens"),
    "film": frozenset({"hdrfilm"}),
    "sampler": _names("independent ldsampler multijitter orthogonal stratified"),
    "rfilter": _names("box catmullrom gaussian lanczos mitchell tent"),
    "integrator": _names(
        "aov depth direct direct_projective moment path prb prb_basic prb_projective prbvolpath "
        "ptracer volpath volpathmis volprim_rf_basic"
    ),
}
"""By the XML tag that they are usually written with."""

_NOT_A_SURFACE = "caches sit on meshes, disks, spheres and cylinders; convert it to a mesh"
_MULTIPLIES = "a few bytes would stand for any number of meshes; write them out as separate meshes"
REFUSED_PLUGINS: dict[str, str] = {
    "blender": "it reads the memory addresses that the scene gives it",
    "bsplinecurve": _NOT_A_SURFACE,
    "ellipsoids": _NOT_A_SURFACE,
    "linearcurve": _NOT_A_SURFACE,
    "sdfgrid": _NOT_A_SURFACE,
    "instance": _MULTIPLIES,
    "shapegroup": _MULTIPLIES,
    "measured_polarized": "it needs a polarized or monochrome render, scenes here have three linear channels",
    "specfilm": "it needs a spectral render, scenes here have three linear channels; use hdrfilm",
    "stokes": "it needs a polarized render, scenes here have three linear channels; use path",
}

ALLOWED_PLUGINS: frozenset[str] = frozenset().union(*PLUGINS.values())


def plugin_refusal(name: str) -> str | None:
    """Why a scene may not use the plugin of this name; None where it may."""
    if name in ALLOWED_PLUGINS:
        return None
    return REFUSED_PLUGINS.get(name, "it is none of the Mitsuba plugins that this loader knows")
