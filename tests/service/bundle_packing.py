"""Bundles for tests, made in memory: what good and hostile ones are packed from."""

import io
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

SENSOR = '<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="8"/></film></sensor>'
LIGHT = '<emitter type="constant"/>'
SHAPE = '<shape type="rectangle"/>'
TRIANGLE = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
PLY = b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n"
YAML = "scene:\n  a: {type: rectangle}\n  light: {type: constant}\n"
GLTF: dict[str, Any] = {"asset": {"version": "2.0"}, "buffers": [{"uri": "data:;base64,AAAA", "byteLength": 3}]}
Entries = Mapping[str, bytes]


def png(width: int, height: int) -> bytes:
    """The head of a PNG of this size; it has no pixels."""
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    chunk = b"IHDR" + header
    start = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return start + struct.pack(">I", 0) + b"IDAT" + struct.pack(">I", zlib.crc32(b"IDAT"))


def xml(body: str, version: str = "3.0.0", head: str = "") -> bytes:
    """A scene with a camera, a light, a shape and whatever else is asked for."""
    return f'{head}<scene version="{version}">{body}{SENSOR}{LIGHT}{SHAPE}</scene>'.encode()


def pack(entries: Entries, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """A plain zip."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def pack_infos(*infos: tuple[zipfile.ZipInfo, bytes]) -> bytes:
    """A zip beside whose good scene stand entries with chosen headers."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("scene.xml", xml(""))
        for info, content in infos:
            archive.writestr(info, content)
    return buffer.getvalue()


def info_of(name: str, **values: Any) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo("placeholder")
    info.filename = info.orig_filename = name
    info.external_attr = 0o100644 << 16
    for key, value in values.items():
        setattr(info, key, value)
    return info


@dataclass(frozen=True)
class Hostile:
    """A bundle that must be refused.

    Attributes:
        label: names the test.
        archive: makes the upload.
        words: what the reason must say (a regular expression).
    """

    label: str
    archive: Callable[[], bytes]
    words: str


def scenes(group: str, bodies: Mapping[str, str], words: str, **others: bytes) -> Iterator[Hostile]:
    """One hostile bundle for each body of an XML scene, with other files beside it."""
    for label, body in bodies.items():
        yield Hostile(f"{group}-{label}", lambda body=body: pack({"scene.xml": xml(body), **others}), words)


def glb(content: bytes) -> bytes:
    content += b" " * (-len(content) % 4)
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(content), len(content), 0x4E4F534A) + content
