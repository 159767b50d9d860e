# ruff: noqa: E501  # tables are read by the row
"""Meshes, pictures, grids and measured materials that must be refused."""

import json
import struct
from collections.abc import Iterator

import numpy as np

from tests.service.bundle_packing import GLTF, PLY, TRIANGLE, Hostile, glb, pack, png, scenes, xml
from tests.workers.plugin_scenes import tensor_file


def bad_meshes() -> Iterator[Hostile]:
    for label, name in (("parent", "../x.mtl"), ("absolute", "/etc/passwd"), ("device", "/dev/zero"), ("url", "http://localhost/x.mtl"),
                        ("drive", "C:\\x.mtl"), ("word", "a.mtl ../x.mtl"), ("home", "~/x")):  # fmt: skip
        for line in (f"mtllib {name}", f"\tmtllib\t{name}", f"# mtllib {name}"):
            content = line.encode() + b"\n" + TRIANGLE
            yield Hostile(
                f"mtllib-{label}-{line[:2]!a}", lambda content=content: pack({"a.obj": content}), "inside the bundle"
            )
        yield Hostile(
            f"mtllib-in-shape-{label}",
            lambda content=content: pack({"scene.xml": xml(""), "a.obj": content}),
            "inside",
        )
        for key in ("map_Kd", "map_bump", "bump", "refl"):
            material = f"newmtl m\n{key} -s 1 1 1 {name}\n".encode()
            yield Hostile(
                f"{key}-{label}",
                lambda material=material: pack({"a.obj": b"mtllib a.mtl\n" + TRIANGLE, "a.mtl": material}),
                "inside",
            )
    for label, uri in (("parent", "../x.bin"), ("encoded", "%2e%2e/x.bin"), ("encoded-slash", "..%2fx.bin"), ("http", "http://localhost/x"), ("https", "HTTPS://localhost/x"),
                       ("file", "file:///etc/passwd"), ("absolute", "/etc/passwd"), ("missing", "no.bin"), ("data", "data:,hello"), ("base64", "data:;base64,!!"),
                       ("number", 7), ("empty", "")):  # fmt: skip
        for key in ("buffers", "images"):
            content = json.dumps({**GLTF, key: [{"uri": uri}]}).encode()
            words = "inside the bundle|file of the bundle|base64|text"
            yield Hostile(f"gltf-{key}-{label}", lambda content=content: pack({"a.gltf": content}), words)
            yield Hostile(f"glb-{key}-{label}", lambda content=content: pack({"a.glb": glb(content)}), words)
    chain = {"nodes": [{"children": [k + 1]} for k in range(400)] + [{}]}
    for label, change in (("count", {"accessors": [{"count": 10**12}]}), ("negative", {"accessors": [{"count": -1}]}), ("circle", {"nodes": [{"children": [0]}]}),
                          ("two-parents", {"nodes": [{"children": [2]}, {"children": [2]}, {}]}), ("child", {"nodes": [{"children": [9]}]}), ("chain", chain),
                          ("list", {"buffers": 3}), ("entries", {"images": ["a"]}), ("no-asset", {"asset": None})):  # fmt: skip
        content = json.dumps({**GLTF, **change}).encode()
        yield Hostile(
            f"gltf-{label}", lambda content=content: pack({"a.gltf": content}), "count|deep|parent|list|asset"
        )
    for label, data in (
        ("json", b"{"),
        ("array", b"[]"),
        ("deep", b"[" * 100_000),
        ("empty", b""),
        ("utf8", b"\xff\xfe{}"),
    ):
        yield Hostile(f"gltf-{label}", lambda data=data: pack({"a.gltf": data}), "JSON|asset")
    for label, data in (
        ("empty", b""),
        ("short", b"glTF"),
        ("version", b"glTF" + bytes(40)),
        ("length", glb(b"{}")[:-2]),
        ("magic", b"GLTF" + glb(b"{}")[4:]),
    ):
        yield Hostile(f"glb-{label}", lambda data=data: pack({"a.glb": data}), "GLB")
    for label, data in (("count", PLY.replace(b"vertex 0", b"vertex 999999999999")), ("magic", b"plz\n"), ("no-end", b"ply\nformat ascii 1.0\n"),
                        ("negative", PLY.replace(b"vertex 0", b"vertex -1")), ("empty", b"")):  # fmt: skip
        yield Hostile(f"ply-{label}", lambda data=data: pack({"a.ply": data}), "PLY|claims")
        yield from scenes(
            "ply-shape",
            {label: '<shape type="ply"><string name="filename" value="a.bin"/></shape>'},
            "PLY|claims",
            **{"a.bin": data},
        )
    yield Hostile("stl-empty", lambda: pack({"a.stl": b""}), "triangles")


def bad_pictures() -> Iterator[Hostile]:
    window = b"dataWindow\x00box2i\x00" + struct.pack("<i4i", 16, 0, 0, 99999, 99999)
    pictures = {
        "png-bomb": png(60000, 60000), "text": b"hello", "empty": b"", "exr-bomb": b"\x76\x2f\x31\x01\x02\x00\x00\x00" + window + b"\x00",
        "exr-short": b"\x76\x2f\x31\x01", "hdr-bomb": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 99999 +X 99999\n", "pfm-bomb": b"PF\n99999 99999\n-1\n",
        "html": b"<html></html>", "svg": b"<svg xmlns='http://www.w3.org/2000/svg'/>", "gif": b"GIF89a" + bytes(20), "png-zero": png(0, 4), "script": b"#!/bin/sh\n",
    }  # fmt: skip
    for label, data in pictures.items():
        yield from scenes(
            "picture",
            {label: '<texture type="bitmap"><string name="filename" value="a.png"/></texture>'},
            "picture",
            **{"a.png": data},
        )
    grid = b"VOL\x03" + struct.pack("<5i", 1, 1000, 1000, 1000, 1) + bytes(24)
    for label, data in (("claims", grid), ("text", b"VOL"), ("negative", grid[:8] + struct.pack("<i", -1) + grid[12:])):
        yield from scenes(
            "grid",
            {label: '<volume type="gridvolume"><string name="filename" value="a.vol"/></volume>'},
            "grid",
            **{"a.vol": data},
        )
    yield from scenes(
        "serialized",
        {"text": '<shape type="serialized"><string name="filename" value="a.bin"/></shape>'},
        "serialized",
        **{"a.bin": b"text"},
    )
    material = tensor_file(theta_i=np.zeros(2, np.float32), ndf=np.ones((2, 2), np.float32))
    shape_at = material.index(b"ndf") + 3 + 11  # after its axes, type and offset
    materials = {
        "text": b"hello", "empty": b"", "cut": material[:40], "magic": b"tensor_fill" + material[11:],
        "version": material[:12] + b"\x02" + material[13:], "many": material[:14] + b"\xff" * 4 + material[18:],
        "long": material[:shape_at] + struct.pack("<2Q", 1 << 60, 1 << 60) + material[shape_at + 16 :],
        "far": material[: shape_at - 8] + struct.pack("<Q", len(material)) + material[shape_at:],
        "type": material[: shape_at - 9] + b"\x63" + material[shape_at - 8 :],
        "axes": material[: shape_at - 11] + b"\xff\xff" + material[shape_at - 9 :],
    }  # fmt: skip
    for label, data in materials.items():
        yield from scenes(
            "measured",
            {label: '<bsdf type="measured"><string name="filename" value="a.bsdf"/></bsdf>'},
            "measured material",
            **{"a.bsdf": data},
        )
