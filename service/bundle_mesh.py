"""Mesh files in a bundle that are scenes themselves: what they refer to stays in the bundle and in bounds."""

import base64
import binascii
import json
import mmap
import posixpath
import re
import struct
from collections.abc import Iterator
from typing import Any
from urllib.parse import unquote

from service.bundle_assets import check_ply
from service.bundle_rules import BundleFiles
from service.errors import BundleError, HostileBundleError

MAX_GLTF_JSON_NBYTES = 64 << 20
MAX_ACCESSOR_COUNT = 1 << 28
MAX_NODE_CHAIN = 256
_GLB = b"glTF"
_JSON_CHUNK = 0x4E4F534A
_OPENED = re.compile(rb"(?i)(mtllib|map_kd)[ \t\x0b\x0c]+([^\r\n]*)")  # what readers open, wherever it stands
_OTHERS = re.compile(rb"(?i)(?:^|[\r\n])[ \t]*(map_\w+|bump|disp|decal|refl|norm)[ \t]+([^\r\n]*)")


def check_mesh_scene(files: BundleFiles, name: str) -> None:
    """Judge a .glb, .gltf, .obj, .ply or .stl file that is to be loaded as a scene.

    Raises:
        HostileBundleError: it names a URL or a file outside the bundle, or claims what it cannot hold.
        BundleError: its header is broken, or a file that it needs is missing.
    """
    suffix = posixpath.splitext(name)[1].lower()
    path, where = files.root / name, f"file {name}"
    if suffix in (".glb", ".gltf"):
        _check_gltf(files, name, where)
    elif suffix == ".obj":
        check_obj(files, name)
    elif suffix == ".ply":
        check_ply(path, where)
    elif path.stat().st_size < 15:
        raise BundleError(where, "must hold triangles", "an empty file")


def check_obj(files: BundleFiles, name: str, with_materials: bool = True) -> None:
    """Files that an OBJ names, and those that its materials name. Missing ones only make it grey.

    Args:
        files: the bundle.
        name: the OBJ, or one of its MTL files.
        with_materials: also look into the MTL files that it names.

    Raises:
        HostileBundleError: a file lies outside the bundle.
    """
    folder = posixpath.dirname(name)
    for where, written in _named(files, name):
        for path in _confined_forms(files, folder, written, where):
            if with_materials and path in files.names and path != name:
                check_obj(files, path, with_materials=False)


def _named(files: BundleFiles, name: str) -> Iterator[tuple[str, str]]:
    """(place, name as written) of whatever in an OBJ or MTL file names another file."""
    path = files.root / name
    if path.stat().st_size == 0:
        return
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        for pattern in (_OPENED, _OTHERS):
            for match in pattern.finditer(content):
                written = match[2].decode("utf-8", "replace").strip()
                if written:
                    yield f"file {name}, {match[1].decode()} at byte {match.start(1)}", written


def _confined_forms(files: BundleFiles, folder: str, written: str, where: str) -> set[str]:
    """Readers take the whole rest of the line, its last word, or each word for a name: all must be confined."""
    forms = {written, *(word for word in written.split() if not word.startswith("-"))}
    return {files.confined(folder, form, where) for form in forms}


def _check_gltf(files: BundleFiles, name: str, where: str) -> None:
    document = _gltf_document(files, name, where)
    folder = posixpath.dirname(name)
    for key in ("buffers", "images"):
        for index, entry in enumerate(_objects(document, key, where)):
            place, uri = f"{where}, {key}[{index}]", entry.get("uri")
            if uri is not None and not isinstance(uri, str):
                raise BundleError(place, "must have a uri that is text", ascii(uri)[:80])
            if uri is not None and uri.startswith("data:"):
                _check_data_uri(uri, place)
            elif uri is not None:
                files.confined(folder, unquote(uri), place)
                files.require([folder], uri, place)
    for index, accessor in enumerate(_objects(document, "accessors", where)):
        count = accessor.get("count", 0)
        if isinstance(count, bool) or not isinstance(count, int) or not 0 <= count <= MAX_ACCESSOR_COUNT:
            raise HostileBundleError(f"{where}, accessors[{index}]", f"must count 0 to {MAX_ACCESSOR_COUNT} values",
                                     ascii(count)[:40])  # fmt: skip
    _check_nodes(document, where)


def _check_nodes(document: dict[str, Any], where: str) -> None:
    """The nodes of a glTF are a forest: each has one parent at most, and none is its own ancestor."""
    nodes = _objects(document, "nodes", where)
    parent: dict[int, int] = {}
    for index, node in enumerate(nodes):
        for child in node.get("children") or []:
            if isinstance(child, bool) or not isinstance(child, int) or not 0 <= child < len(nodes) or child in parent:
                raise BundleError(f"{where}, nodes[{index}]", "must have children that are nodes of one parent",
                                  ascii(child)[:40])  # fmt: skip
            parent[child] = index
    for index in range(len(nodes)):
        length, node_index = 0, index
        while node_index in parent:
            length, node_index = length + 1, parent[node_index]
            if length > MAX_NODE_CHAIN:
                raise HostileBundleError(f"{where}, nodes[{index}]", f"must lie at most {MAX_NODE_CHAIN} deep", "more")


def _objects(document: dict[str, Any], key: str, where: str) -> list[dict[str, Any]]:
    entries = document.get(key, [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise BundleError(f"{where}, {key}", "must be a list of objects", type(entries).__name__)
    return entries


def _check_data_uri(uri: str, where: str) -> None:
    head, separator, data = uri.partition(";base64,")
    try:
        if not separator:
            raise ValueError("no base64")
        base64.b64decode(data, validate=True)
    except (ValueError, binascii.Error) as error:
        raise BundleError(where, "must hold base64 data", f"{head[:40]!a} ({error})") from None


def _gltf_document(files: BundleFiles, name: str, where: str) -> dict[str, Any]:
    path = files.root / name
    content = path.read_bytes()
    if name.lower().endswith(".glb"):
        try:
            magic, version, nbytes, chunk_nbytes, kind = struct.unpack_from("<4sIIII", content)
        except struct.error:
            raise BundleError(where, "must have a GLB header", "a file that is too short") from None
        if magic != _GLB or version != 2 or kind != _JSON_CHUNK or nbytes > len(content) or 20 + chunk_nbytes > nbytes:
            raise BundleError(where, "must be a whole GLB of version 2", "another header or length")
        content = content[20 : 20 + chunk_nbytes]
    if len(content) > MAX_GLTF_JSON_NBYTES:
        raise BundleError(where, f"must have a JSON of at most {MAX_GLTF_JSON_NBYTES} bytes", f"{len(content)}")
    try:
        document = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise BundleError(where, "must hold valid JSON", " ".join(str(error).split())[:200]) from None
    if not isinstance(document, dict) or not isinstance(document.get("asset"), dict):
        raise BundleError(where, "must be a glTF document with an asset", "another JSON value")
    return document
