"""For every plugin that a scene may name, a scene of a few elements that uses it, and the files that they read."""

import struct
import zlib
from pathlib import Path

import numpy as np

from tests.exr_files import write_exr
from workers.backend import mi

_POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4")
_PICTURE = "<string name='filename' value='picture.png'/>"
_DIFFUSE = "<bsdf type='diffuse'/>"
_ON_A_CUBE = "<shape type='cube'>{}</shape>"
_AS_REFLECTANCE = _ON_A_CUBE.format("<bsdf type='diffuse'><texture type='{}' name='reflectance'>{}</texture></bsdf>")
_AS_PHASE = _ON_A_CUBE.format("<medium type='homogeneous' name='interior'><phase type='{}'>{}</phase></medium>")
_SECOND_SENSOR = "<sensor type='perspective'/><sensor type='{}'>{}</sensor>"
BY_NAME = {
    "bsdf": _ON_A_CUBE.format("<bsdf type='{}'/>"),
    "emitter": "<emitter type='{}'/>",
    "shape": "<shape type='{}'/>",
    "texture": _AS_REFLECTANCE.format("{}", ""),
    "medium": _ON_A_CUBE.format("<medium type='{}' name='interior'/>"),
    "phase": _AS_PHASE.format("{}", ""),
    "sensor": _SECOND_SENSOR.format("{}", ""),
    "film": "<sensor type='perspective'><film type='{}'/></sensor>",
    "sampler": "<sensor type='perspective'><sampler type='{}'/></sensor>",
    "rfilter": "<sensor type='perspective'><film type='hdrfilm'><rfilter type='{}'/></film></sensor>",
    "integrator": "<integrator type='{}'/>",
}
"""A scene's elements, by the plugin's tag, where its name is all that it needs."""


def _of_file(name: str, suffix: str) -> str:
    return f"<shape type='{name}'><string name='filename' value='mesh.{suffix}'/></shape>"


BY_PLUGIN = {
    "blendbsdf": _ON_A_CUBE.format(f"<bsdf type='blendbsdf'><float name='weight' value='1'/>{_DIFFUSE * 2}</bsdf>"),
    "bumpmap": _ON_A_CUBE.format(f"<bsdf type='bumpmap'><texture type='bitmap'>{_PICTURE}</texture>{_DIFFUSE}</bsdf>"),
    "mask": _ON_A_CUBE.format(f"<bsdf type='mask'>{_DIFFUSE}</bsdf>"),
    "measured": _ON_A_CUBE.format("<bsdf type='measured'><string name='filename' value='material.bsdf'/></bsdf>"),
    "normalmap": _ON_A_CUBE.format(
        f"<bsdf type='normalmap'><texture type='bitmap' name='normalmap'>{_PICTURE}</texture>{_DIFFUSE}</bsdf>"
    ),
    "twosided": _ON_A_CUBE.format(f"<bsdf type='twosided'>{_DIFFUSE}</bsdf>"),
    "area": "<shape type='rectangle'><emitter type='area'/></shape>",
    "directionalarea": "<shape type='rectangle'><emitter type='directionalarea'/></shape>",
    "envmap": "<emitter type='envmap'><string name='filename' value='sky.exr'/></emitter>",
    "projector": f"<emitter type='projector'><texture type='bitmap' name='irradiance'>{_PICTURE}</texture></emitter>",
    "ellipsoidsmesh": "<shape type='ellipsoidsmesh'><string name='filename' value='ellipsoid.ply'/></shape>",
    "merge": f"<shape type='merge'>{_of_file('obj', 'obj')}{_of_file('ply', 'ply')}</shape>",
    "obj": _of_file("obj", "obj"),
    "ply": _of_file("ply", "ply"),
    "serialized": _of_file("serialized", "serialized"),
    "bitmap": _AS_REFLECTANCE.format("bitmap", _PICTURE),
    "blackbody": _AS_REFLECTANCE.format("blackbody", "<float name='temperature' value='3000'/>"),
    "uniform": _AS_REFLECTANCE.format("uniform", "<float name='value' value='0.5'/>"),
    "irregular": _AS_REFLECTANCE.format(
        "irregular", "<string name='wavelengths' value='400, 700'/><string name='values' value='0.5, 0.5'/>"
    ),
    "mesh_attribute": _AS_REFLECTANCE.format("mesh_attribute", "<string name='name' value='vertex_color'/>"),
    "rawconstant": _AS_REFLECTANCE.format("rawconstant", "<float name='value' value='0.5'/>"),
    "regular": _AS_REFLECTANCE.format(
        "regular",
        "<float name='wavelength_min' value='400'/><float name='wavelength_max' value='700'/>"
        "<string name='values' value='0.5, 0.5'/>",
    ),
    "srgb": _AS_REFLECTANCE.format("srgb", "<rgb name='color' value='0.5, 0.5, 0.5'/>"),
    "volume": _AS_REFLECTANCE.format(
        "volume", "<volume type='constvolume' name='volume'><rgb name='value' value='0.5, 0.5, 0.5'/></volume>"
    ),
    "constvolume": _AS_REFLECTANCE.format(
        "volume", "<volume type='constvolume' name='volume'><rgb name='value' value='0.5, 0.5, 0.5'/></volume>"
    ),
    "gridvolume": _AS_REFLECTANCE.format(
        "volume", "<volume type='gridvolume' name='volume'><string name='filename' value='one.vol'/></volume>"
    ),
    "blendphase": _AS_PHASE.format(
        "blendphase", "<float name='weight' value='0.5'/><phase type='isotropic'/><phase type='hg'/>"
    ),
    "sggx": _AS_PHASE.format(
        "sggx", "<volume type='gridvolume' name='S'><string name='filename' value='six.vol'/></volume>"
    ),
    "tabphase": _AS_PHASE.format("tabphase", "<string name='values' value='0.5, 1, 0.5'/>"),
    "batch": _SECOND_SENSOR.format("batch", "<sensor type='perspective'/>"),
    "distant": _SECOND_SENSOR.format("distant", "<film type='hdrfilm'><rfilter type='box'/></film>"),
    "radiancemeter": _SECOND_SENSOR.format("radiancemeter", "<film type='hdrfilm'><rfilter type='box'/></film>"),
    "irradiancemeter": "<sensor type='perspective'/><shape type='rectangle'><sensor type='irradiancemeter'>"
    "<film type='hdrfilm'><rfilter type='box'/></film></sensor></shape>",
    "perspective": "<sensor type='perspective'/>",
    "thinlens": "<sensor type='thinlens'><float name='aperture_radius' value='0.1'/></sensor>",
    "aov": "<integrator type='aov'><string name='aovs' value='d:depth'/><integrator type='path'/></integrator>",
}
"""The elements of those that need values, files or a place of their own."""

OF_ONE_PIXEL = ("distant", "radiancemeter")
"""Sensors that take one pixel only; the loader gives every film of a scene the same size."""


def write_plugin_scene(folder: Path, tag: str, name: str) -> Path:
    """A scene.xml that uses the plugin, with all the files that such scenes may read beside it."""
    body = BY_PLUGIN.get(name) or BY_NAME[tag].format(name)
    sensor = "" if "<sensor" in body else "<sensor type='perspective'/>"
    light = "" if "<emitter" in body else "<emitter type='point'/>"
    _write_files(folder)
    path = folder / "scene.xml"
    path.write_text(f"<scene version='3.0.0'>{body}{sensor}{light}<shape type='rectangle'/></scene>")
    return path


def _write_files(folder: Path) -> None:
    grey = np.full((4, 4, 3), 0.5, np.float32)
    mi.util.write_bitmap(str(folder / "picture.png"), grey, write_async=False)
    write_exr(folder / "sky.exr", grey)
    (folder / "mesh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (folder / "mesh.ply").write_text(_ply("x y z", ["0 0 0", "1 0 0", "0 1 0"], faces=["3 0 1 2"]))
    ellipsoid = "x y z nx ny nz scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    (folder / "ellipsoid.ply").write_text(_ply(ellipsoid, ["0 0 0 0 0 1 1 1 1 1 0 0 0"]))
    (folder / "mesh.serialized").write_bytes(_serialized())
    (folder / "one.vol").write_bytes(_grid([0.5]))
    (folder / "six.vol").write_bytes(_grid([1, 1, 1, 0, 0, 0]))
    (folder / "material.bsdf").write_bytes(tensor_file(**_measurement()))


def _ply(properties: str, vertices: list[str], faces: list[str] | None = None) -> str:
    lines = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    lines += [f"property float {name}" for name in properties.split()]
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    return "\n".join([*lines, "end_header", *vertices, *(faces or []), ""])


def _serialized() -> bytes:
    """One triangle in Mitsuba's own format, version 4, single precision, without normals."""
    header = struct.pack("<I", 0x1000) + b"mesh\x00" + struct.pack("<QQ", 3, 1)
    mesh = zlib.compress(header + _POINTS.tobytes() + np.arange(3, dtype="<u4").tobytes())
    return struct.pack("<HH", 0x041C, 4) + mesh + struct.pack("<QI", 0, 1)


def _grid(channels: list[float]) -> bytes:
    """2x2x2 voxels of float32, all alike."""
    values = np.tile(np.array(channels, "<f4"), 8)
    return b"VOL\x03" + struct.pack("<5i6f", 1, 2, 2, 2, len(channels), 0, 0, 0, 1, 1, 1) + values.tobytes()


def _measurement() -> dict[str, np.ndarray]:
    """A measured material of two polar angles, isotropic."""
    ones = {"ndf": (2, 2), "sigma": (2, 2), "vndf": (1, 2, 2, 2), "luminance": (1, 2, 2, 2), "rgb": (1, 2, 3, 2, 2)}
    arrays = {name: np.ones(shape, np.float32) for name, shape in ones.items()}
    return {
        "description": np.frombuffer(b"none", np.uint8), "phi_i": np.zeros(1, np.float32),
        "theta_i": np.array([0, 1.5], np.float32), "jacobian": np.ones(1, np.uint8), **arrays,
    }  # fmt: skip


def tensor_file(**arrays: np.ndarray) -> bytes:
    """Named arrays in the format of measured materials: a table of fields, then their values."""
    heads = [(name.encode(), array) for name, array in arrays.items()]
    offset = 18 + sum(13 + len(name) + 8 * array.ndim for name, array in heads)
    table, values = b"", b""
    for name, array in heads:
        kind = 1 if array.dtype == np.uint8 else 10
        table += struct.pack("<H", len(name)) + name + struct.pack("<HBQ", array.ndim, kind, offset + len(values))
        table += struct.pack(f"<{array.ndim}Q", *array.shape)
        values += array.tobytes() + bytes(-array.nbytes % 8)
    return b"tensor_file\x00" + struct.pack("<BBI", 1, 0, len(heads)) + table + values
