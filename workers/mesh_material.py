"""Materials of mesh files as Mitsuba BSDFs: glTF's metallic-roughness to `principled`, OBJ's Phong to
plastic."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from workers.backend import mi

GREY = 0.6
GLASS_ALPHA = 0.5  # a blended surface that is more transparent than this is taken for glass


@dataclass(kw_only=True)
class Material:
    """What a mesh is made of.

    Attributes:
        bsdf: dictionary for `mi.load_dict`.
        emitter: likewise, where it shines.
        attributes: {"vertex_color" | "face_color": [vertices | faces, 3]} linear Rec.709.
        notes: what was approximated.
    """

    bsdf: dict[str, Any]
    emitter: dict[str, Any] | None = None
    attributes: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def read_material(geometry: trimesh.Trimesh, has_texcoords: bool) -> Material:
    """The material of one mesh; grey diffuse where the file has none."""
    visual: Any = geometry.visual
    if visual.kind in ("vertex", "face"):
        colours = visual.vertex_colors if visual.kind == "vertex" else visual.face_colors
        name = f"{visual.kind}_color"
        linear = srgb_to_linear(np.asarray(colours, dtype=np.float64)[:, :3] / 255)
        reflectance = {"type": "mesh_attribute", "name": name}
        return Material(bsdf=_two_sided(_diffuse(reflectance)), attributes={name: linear})
    material = getattr(visual, "material", None)
    if isinstance(material, trimesh.visual.material.PBRMaterial):
        return _from_pbr(material, has_texcoords)
    if isinstance(material, trimesh.visual.material.SimpleMaterial):
        return _from_phong(material, has_texcoords)
    return Material(bsdf=_two_sided(_diffuse(_rgb([GREY] * 3))))


def srgb_to_linear(encoded: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse sRGB curve (IEC 61966-2-1) on values in [0, 1]."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def _from_pbr(material: Any, has_texcoords: bool) -> Material:
    factor = np.ones(4) if material.baseColorFactor is None else _unit(material.baseColorFactor)
    image = material.baseColorTexture if has_texcoords else None
    bsdf = {
        "type": "principled",
        "base_color": _rgb(factor[:3]) if image is None else _colour_texture(image, factor[:3]),
        **_metallic_roughness(material, has_texcoords),
    }
    if material.normalTexture is not None and has_texcoords:
        normals = _bitmap(np.asarray(material.normalTexture.convert("RGB")), raw=True)
        bsdf = {"type": "normalmap", "normalmap": normals, "bsdf": bsdf}
    emitter = _emission(material, has_texcoords)
    mode = (material.alphaMode or "OPAQUE").upper()
    if mode == "OPAQUE":
        return Material(bsdf=_two_sided(bsdf), emitter=emitter)
    return _transparent(bsdf, emitter, mode, float(factor[3]), image, material.alphaCutoff)


def _metallic_roughness(material: Any, has_texcoords: bool) -> dict[str, Any]:
    """glTF packs roughness into green and metalness into blue, both linear, each times its factor."""
    roughness = 1.0 if material.roughnessFactor is None else float(material.roughnessFactor)
    metallic = 1.0 if material.metallicFactor is None else float(material.metallicFactor)
    if material.metallicRoughnessTexture is None or not has_texcoords:
        return {"roughness": roughness, "metallic": metallic}
    packed = np.asarray(material.metallicRoughnessTexture.convert("RGB"), dtype=np.float32) / 255
    return {
        "roughness": _bitmap(packed[..., 1:2] * np.float32(roughness), raw=True),
        "metallic": _bitmap(packed[..., 2:3] * np.float32(metallic), raw=True),
    }


def _emission(material: Any, has_texcoords: bool) -> dict[str, Any] | None:
    factor = np.zeros(3) if material.emissiveFactor is None else np.asarray(material.emissiveFactor, dtype=np.float64)
    if factor.max() <= 0:
        return None
    image = material.emissiveTexture if has_texcoords else None
    return {"type": "area", "radiance": _rgb(factor) if image is None else _colour_texture(image, factor)}


def _transparent(
    bsdf: dict[str, Any],
    emitter: dict[str, Any] | None,
    mode: str,
    alpha: float,
    image: Any,
    cutoff: float | None,
) -> Material:
    """Blended glass becomes a thin dielectric; everything else a stochastic or cut-out mask."""
    channel = None
    if image is not None and "A" in image.getbands():
        channel = np.asarray(image.getchannel("A"), dtype=np.float32)[..., None] / 255 * np.float32(alpha)
    if channel is None and mode == "BLEND" and alpha < GLASS_ALPHA:
        return Material(
            bsdf={"type": "thindielectric"},
            emitter=emitter,
            notes=["blended materials of low opacity are taken for thin clear glass"],
        )
    if mode == "MASK":
        limit = 0.5 if cutoff is None else float(cutoff)
        alpha = float(alpha >= limit)
        channel = None if channel is None else (channel >= limit).astype(np.float32)
    if channel is None and alpha >= 1:
        return Material(bsdf=_two_sided(bsdf), emitter=emitter)
    opacity = alpha if channel is None else _bitmap(channel, raw=True)
    return Material(
        bsdf={"type": "mask", "opacity": opacity, "bsdf": _two_sided(bsdf)},
        emitter=emitter,
        notes=["transparent materials are masks: light passes straight through or not"],
    )


def _from_phong(material: Any, has_texcoords: bool) -> Material:
    """OBJ: Kd or map_Kd is the diffuse part; a specular part becomes a coat of roughness sqrt(2 / (Ns +
    2))."""
    image = material.image if has_texcoords else None
    diffuse = _rgb(_unit(material.diffuse)[:3]) if image is None else _colour_texture(image, np.ones(3))
    specular = 0.0 if material.specular is None else float(_unit(material.specular)[:3].max())
    shine = float(material.glossiness or 0.0)
    if specular <= 0 or shine <= 1:
        return Material(bsdf=_two_sided(_diffuse(diffuse)))
    alpha = float(np.clip(np.sqrt(2 / (shine + 2)), 0.03, 1.0))
    return Material(bsdf=_two_sided({"type": "roughplastic", "diffuse_reflectance": diffuse, "alpha": alpha}))


def _unit(colour: Any) -> NDArray[np.float64]:
    """Colour in [0, 1] from trimesh's bytes or floats; four channels."""
    values = np.asarray(colour)
    unit = values / 255.0 if values.dtype.kind in "ui" else values.astype(np.float64)
    return np.concatenate([unit, np.ones(max(0, 4 - len(unit)))])


def _rgb(value: Any) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(channel) for channel in value]}


def _diffuse(reflectance: dict[str, Any]) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": reflectance}


def _two_sided(bsdf: dict[str, Any]) -> dict[str, Any]:
    return {"type": "twosided", "bsdf": bsdf}


def _colour_texture(image: Any, factor: NDArray[np.float64]) -> dict[str, Any]:
    """An sRGB image times a linear factor; the bytes themselves where the factor is 1."""
    encoded = np.asarray(image.convert("RGB"))
    if np.allclose(factor, 1):
        return _bitmap(encoded, raw=False)
    curve = srgb_to_linear(np.arange(256) / 255).astype(np.float32)
    return _bitmap(curve[encoded] * factor.astype(np.float32), raw=True)


def _bitmap(values: NDArray[Any], *, raw: bool) -> dict[str, Any]:
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.array(values, order="C")), "raw": raw}
