"""Applies a variation to a built scene, whatever kind of file it came from.

The built scene is changed, not the file: its parameters (`mi.traverse`) are the same for XML, YAML, mesh files and
scenes made by code. Every draw belongs to a shape's or light's id, because the order of shapes is not stable between
processes. What cannot be changed here: conductors without a tint, reflectances by wavelength, lights without a
radiance, intensity or irradiance.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.keys import canonical_json
from workers.backend import mi
from workers.scene_draft import text_hash
from workers.variation import VARIATION_VERSION, Variation

Floats = NDArray[np.float64]
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # Rec. 709
_REFLECTANCES = ("reflectance", "diffuse_reflectance", "base_color", "specular_reflectance", "specular_transmittance")
_EMISSIONS = ("radiance", "intensity", "irradiance")
_SCALES = ("scale", "sun_scale", "sky_scale")
_LOWEST, _HIGHEST = 0.05, 0.85  # reflectance of a random colour: nothing absorbs or reflects all
_DIGITS = 6  # of what is drawn: the same on every machine, and what the digest speaks of
_ATTRIBUTES = ("vertex_color", "face_color")


def vary_scene(mi_scene: Any, variation: Variation) -> list[dict[str, Any]]:
    """Changes a built scene in place.

    Args:
        mi_scene: the `mi.Scene`; every shape has an id.
        variation: how far, and from which seed.

    Returns:
        What was changed, by name: {"parameter", "value"} or {"parameter", "gain"}, three linear Rec. 709 channels.
    """
    changes: list[dict[str, Any]] = []
    if variation.materials > 0:
        for name, owner, is_shape in _materials(mi_scene):
            changes += _vary_material(name, owner, is_shape, variation)
    if variation.light != (1.0, 1.0) or variation.light_colour > 0:
        for name, emitter in _lights(mi_scene):
            changes += _vary_light(name, emitter, variation)
    return sorted(changes, key=lambda change: change["parameter"])


def content_of(changes: list[dict[str, Any]], variation: Variation) -> list[tuple[str, str]]:
    """What a variation adds to the content that a scene's digest is made from: nothing where nothing changed."""
    camera = {"amount": variation.camera, "seed": variation.seed} if variation.camera > 0 else None
    if not changes and camera is None:
        return []
    content = {"version": VARIATION_VERSION, "changes": changes, "camera": camera}
    return [("variation", text_hash(canonical_json(content).decode("ascii")))]


# ---------------------------------------------------- materials -----------------------------------------------------


def _materials(mi_scene: Any) -> Iterator[tuple[str, Any, bool]]:
    """(name, object, whether it is a shape) of what holds reflectances; a shared BSDF comes once, under the first
    shape's id."""
    seen: set[int] = set()
    for shape in sorted(mi_scene.shapes(), key=lambda shape: shape.id()):
        if any(name in mi.traverse(shape) for name in _ATTRIBUTES):
            yield shape.id(), shape, True
        bsdf = shape.bsdf()
        if bsdf is not None and bsdf.ptr not in seen:
            seen.add(bsdf.ptr)
            yield f"{shape.id()}.bsdf", bsdf, False


def _vary_material(name: str, owner: Any, is_shape: bool, variation: Variation) -> list[dict[str, Any]]:
    parameters = mi.traverse(owner)
    share, changes = variation.materials, []
    for key in sorted(parameters.keys()):
        stem, _, leaf = key.rpartition(".")
        rng = variation.random("material", name, key)
        if is_shape:
            if key in _ATTRIBUTES:
                changes.append(_gain(parameters, name, key, _texel_gain(share, rng)))
        elif stem.rpartition(".")[2] not in _REFLECTANCES:
            continue
        elif leaf == "value" and _is_colour(parameters[key]):
            mixed = (1 - share) * _colour(parameters[key]) + share * rng.uniform(_LOWEST, _HIGHEST, 3)
            changes.append(_set(parameters, name, key, mixed))
        elif leaf == "data":
            changes.append(_gain(parameters, name, key, _texel_gain(share, rng)))
    if changes:
        parameters.update()
    return changes


def _texel_gain(share: float, rng: np.random.Generator) -> Floats:
    """Factors of at most 1 for the texels as they are stored (8-bit ones are sRGB-encoded), so that none clips."""
    return _rounded(1 - share * (1 - rng.uniform(0.25, 1.0, 3)))


# ------------------------------------------------------ lights ------------------------------------------------------


def _lights(mi_scene: Any) -> Iterator[tuple[str, Any]]:
    """Lights by a name that does not depend on their order: the shape's or their own id, else their content."""
    for emitter in mi_scene.emitters():
        shape = emitter.get_shape()
        if shape is not None:
            yield f"{shape.id()}.emitter", emitter
        else:
            yield emitter.id() or f"{emitter.class_name()}-{_content_tag(emitter)}", emitter


def _content_tag(emitter: Any) -> str:
    parameters = mi.traverse(emitter)
    values = [(key, np.array(_matrix(parameters[key])).tobytes().hex()) for key in sorted(parameters.keys())]
    return text_hash(repr(values))[:8]


def _matrix(value: Any) -> Any:
    return value.matrix if hasattr(value, "matrix") else value


def _vary_light(name: str, emitter: Any, variation: Variation) -> list[dict[str, Any]]:
    rng = variation.random("light", name)
    factor = float(np.exp(rng.uniform(*np.log(variation.light))))
    random_colour = rng.uniform(0.0, 1.0, 3)
    tint = (1 - variation.light_colour) + variation.light_colour * random_colour / (LUMINANCE @ random_colour)
    gain = _rounded(factor * tint)
    parameters = mi.traverse(emitter)
    keys = [key for key in sorted(parameters.keys()) if _is_emission(key, parameters[key])]
    changes = []
    for key in keys:
        if key.endswith("data"):
            changes.append(_gain(parameters, name, key, gain))
        else:
            changes.append(_set(parameters, name, key, _colour(parameters[key]) * gain))
    if not keys:
        # Procedural skies have no colours of their own: only how bright they are can be changed.
        for key in sorted(set(parameters.keys()) & set(_SCALES)):
            parameters[key] = float(_rounded(_colour(parameters[key])[0] * factor))
            changes.append({"parameter": f"{name}.{key}", "value": [parameters[key]] * 3})
    if changes:
        parameters.update()
    return changes


def _is_emission(key: str, value: Any) -> bool:
    stem, _, leaf = key.rpartition(".")
    if leaf == "value" and stem.rpartition(".")[2] in _EMISSIONS:
        return _is_colour(value)
    return leaf == "data"  # the texels of an environment map, or of a textured area light


# ---------------------------------------------------- parameters ----------------------------------------------------


def _is_colour(value: Any) -> bool:
    return np.array(value).size in (1, 3)


def _colour(value: Any) -> Floats:
    """[3] linear Rec. 709 channels of a colour or a grey number."""
    return np.broadcast_to(np.array(value, dtype=np.float64).ravel(), 3).copy()


def _rounded(values: Any) -> Floats:
    scaled = np.asarray(values, dtype=np.float64)
    return np.array([float(f"{value:.{_DIGITS}g}") for value in scaled.ravel()]).reshape(scaled.shape)


def _set(parameters: Any, name: str, key: str, colour: Floats) -> dict[str, Any]:
    value, old = _rounded(colour), parameters[key]
    if np.array(old).size == 1:  # a grey number stays one
        value = np.repeat(_rounded(value @ LUMINANCE), 3)
        parameters[key] = type(old)(float(value[0])) if type(old) is not float else float(value[0])
    else:
        parameters[key] = type(old)(*value.tolist())
    return {"parameter": f"{name}.{key}", "value": value.tolist()}


def _gain(parameters: Any, name: str, key: str, gain: Floats) -> dict[str, Any]:
    """Multiplies texels or mesh attributes by three factors (their luminance where they have one channel)."""
    old = parameters[key]
    texels = np.array(old)
    if texels.dtype == np.uint8:  # cannot hold more than it does: only the colour and less light
        gain = _rounded(gain / max(1.0, float(gain.max())))
    channels = texels.shape[-1] if texels.ndim > 1 else 3
    factors = gain[:channels] if channels >= 3 else np.repeat(_rounded(gain @ LUMINANCE), channels)
    factors = np.concatenate([factors, np.ones(max(channels - 3, 0))])  # alpha stays
    scaled = texels.reshape(-1, channels).astype(np.float64) * factors
    if texels.dtype == np.uint8:
        scaled = np.rint(scaled)
    parameters[key] = type(old)(scaled.reshape(texels.shape).astype(texels.dtype))
    return {"parameter": f"{name}.{key}", "gain": gain.tolist()}
