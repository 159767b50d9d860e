"""Pictures, meshes and grids that a scene names: their headers, before a reader believes them.

A picture of a few kilobytes can claim terabytes of pixels, a mesh header any number of vertices. Readers allocate
what a header claims, so the claims are compared with what the file can hold.
"""

import math
import re
import struct
from pathlib import Path

from service.errors import BundleError, HostileBundleError

MAX_PICTURE_PIXELS = 16384 * 16384
_HEADER_NBYTES = 1 << 16
_PILLOW_FORMATS = ("PNG", "JPEG", "BMP", "PPM", "TGA")  # besides EXR, RGBE and PFM all that Mitsuba reads
_EXR, _PLY, _VOL, _SERIALIZED = b"\x76\x2f\x31\x01", b"ply", b"VOL", b"\x1c\x04"
_RGBE_SIZE = re.compile(rb"\n[-+][XY] +(\d{1,9}) +[-+][XY] +(\d{1,9})\s*\n")
_PFM_SIZE = re.compile(rb"P[Ff]\s+(\d{1,9})\s+(\d{1,9})\s")
_PLY_COUNT = re.compile(rb"^element[ \t]+(\S+)[ \t]+(\S+)", re.MULTILINE)
_BYTES_OF_TYPE = {1: 4, 2: 2, 3: 1}  # of a .vol grid: float32, float16, uint8
_TENSORS = b"tensor_file\x00\x01\x00"
_TENSOR_NBYTES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 8, 8: 8, 9: 2, 10: 4, 11: 8}  # by the number of its type
_MAX_TENSORS, _MAX_TENSOR_AXES = 64, 8


def check_asset(plugin: str, path: Path, where: str) -> None:
    """Judge the file that a plugin names.

    Raises:
        HostileBundleError: its header claims more than any reader should allocate.
        BundleError: it is not what the plugin reads.
    """
    if plugin in ("bitmap", "envmap"):
        check_picture(path, where)
    elif plugin in ("ply", "ellipsoidsmesh"):
        check_ply(path, where)
    elif plugin == "gridvolume":
        _check_grid(path, where)
    elif plugin == "serialized" and not _start(path).startswith(_SERIALIZED):
        raise BundleError(where, "must name a serialized mesh", "a file of another kind")
    elif plugin == "measured":
        _check_tensors(path, where)


def _start(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(_HEADER_NBYTES)


def check_picture(path: Path, where: str) -> None:
    """A picture's format and size, from its header.

    Raises:
        HostileBundleError: over `MAX_PICTURE_PIXELS`.
        BundleError: no picture that Mitsuba reads.
    """
    start = _start(path)
    if start.startswith(_EXR):
        size = _exr_size(start)
    elif match := _RGBE_SIZE.search(start) if start.startswith(b"#?") else _PFM_SIZE.match(start):
        size = int(match[1]), int(match[2])
    else:
        size = _pillow_size(path)
    if size is None or min(size) < 1:
        raise BundleError(
            where, "must name a PNG, JPEG, EXR, HDR, PFM, PPM, TGA or BMP picture", "a file of another kind"
        )
    if size[0] * size[1] > MAX_PICTURE_PIXELS:
        raise HostileBundleError(where, f"must name a picture of at most {MAX_PICTURE_PIXELS} pixels",
                                 f"{size[0]}x{size[1]}")  # fmt: skip


def _pillow_size(path: Path) -> tuple[int, int] | None:
    from PIL import Image

    try:
        with Image.open(path, formats=_PILLOW_FORMATS) as picture:
            return picture.size
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        return MAX_PICTURE_PIXELS, 2
    except (OSError, ValueError, SyntaxError, TypeError, struct.error, OverflowError):
        return None


def _exr_size(start: bytes) -> tuple[int, int] | None:
    """Of the first part's data window: attributes are name, type, length, value."""
    place = 8
    try:
        while start[place] != 0:
            name_end = start.index(b"\x00", place)
            type_end = start.index(b"\x00", name_end + 1)
            (length,) = struct.unpack_from("<i", start, type_end + 1)
            value = type_end + 5
            if length < 0:
                return None
            if start[place:name_end] == b"dataWindow":
                left, top, right, bottom = struct.unpack_from("<4i", start, value)
                return right - left + 1, bottom - top + 1
            place = value + length
    except (IndexError, ValueError, struct.error):
        pass
    return None


def check_ply(path: Path, where: str) -> None:
    """A PLY header whose counts the file can hold: every element takes a byte at least.

    Raises:
        HostileBundleError: more elements than bytes.
        BundleError: no PLY header.
    """
    start = _start(path)
    end = start.find(b"end_header")
    if not start.startswith(_PLY) or end < 0:
        raise BundleError(where, "must name a PLY mesh with a header", "a file of another kind")
    nbytes = path.stat().st_size
    for _, count in _PLY_COUNT.findall(start[:end].replace(b"\r", b"\n")):
        if not re.fullmatch(rb"\d{1,18}", count):
            raise BundleError(where, "must name a PLY mesh with whole element counts", ascii(count[:40]))
        if int(count) > nbytes:
            raise HostileBundleError(where, "must name a mesh that holds what it claims",
                                     f"{int(count)} elements in {nbytes} bytes")  # fmt: skip


def _check_grid(path: Path, where: str) -> None:
    start = _start(path)
    if len(start) < 48 or not start.startswith(_VOL):
        raise BundleError(where, "must name a VOL grid", "a file of another kind")
    kind, *counts = struct.unpack_from("<5i", start, 4)
    claimed = _BYTES_OF_TYPE.get(kind, 1)
    for count in counts:
        claimed *= max(count, 0)
    if min(counts) < 1 or claimed > path.stat().st_size:
        raise HostileBundleError(where, "must name a grid that holds what it claims", f"{claimed} bytes")


def _check_tensors(path: Path, where: str) -> None:
    """A measured material: a table of named tensors (name, axes, type, offset, shape), each within the file."""
    start, nbytes = _start(path), path.stat().st_size
    rule = "must name a measured material whose tensors lie in the file"
    try:
        (num_tensors,) = struct.unpack_from("<I", start, len(_TENSORS))
        place = len(_TENSORS) + 4
        if not start.startswith(_TENSORS) or num_tensors > _MAX_TENSORS:
            raise BundleError(where, "must name a measured material", "a file of another kind")
        for _ in range(num_tensors):
            (name_nbytes,) = struct.unpack_from("<H", start, place)
            num_axes, kind, offset = struct.unpack_from("<HBQ", start, place + 2 + name_nbytes)
            if num_axes > _MAX_TENSOR_AXES or kind not in _TENSOR_NBYTES:
                raise BundleError(where, rule, f"one of type {kind} with {num_axes} axes")
            shape = struct.unpack_from(f"<{num_axes}Q", start, place + 13 + name_nbytes)
            end = offset + _TENSOR_NBYTES[kind] * math.prod(shape)
            if end > nbytes:
                raise HostileBundleError(where, rule, f"one up to byte {end} of {nbytes}")
            place += 13 + name_nbytes + 8 * num_axes
    except struct.error:
        raise BundleError(where, rule, "a table that is cut off") from None
