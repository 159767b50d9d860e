"""Frames at rest: multi-part OpenEXR in memory, one part a layer, with Open Image Denoise's feature names.

Radiance, positions and distances are stored as 32-bit floats, bounded layers as halves. Row 0 is the top row.
"""

import io
import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import OpenEXR

from storage.errors import FrameError

HALF_MAX = 65504.0  # largest finite half
_LAYER = "lightwellLayer"
_NUM_LAYERS = "lightwellNumLayers"
_CHECKSUM = "lightwellCrc32"
_MAX_NAME_NBYTES = 200  # channel names may have 255
_NUM_THREADS = 0  # decode in the calling thread: torch, Dr.Jit and Dask already share the cores
_RGB = ("R", "G", "B")
_XYZ = ("X", "Y", "Z")


@dataclass(frozen=True)
class Feature:
    """How a layer lies in the file.

    Attributes:
        part: name of the EXR part and prefix of its channels (`hdr` gives `hdr.R`).
        channels: suffix of each channel, in the order of the layer's last axis.
        dtype: "float" or "half".
    """

    part: str
    channels: tuple[str, ...]
    dtype: str = "half"


# The one table of layers. hdr, alb and nrm are the features of Open Image Denoise's training tools.
FEATURES: dict[str, Feature] = {
    "radiance": Feature("hdr", _RGB, "float"),
    "standard_error": Feature("err", _RGB, "float"),
    "variance": Feature("var", _RGB, "float"),
    "ir": Feature("ir", _RGB, "float"),
    "diffuse": Feature("dif", _RGB, "float"),
    "specular": Feature("spc", _RGB, "float"),
    "emission": Feature("emi", _RGB, "float"),
    "position": Feature("pos", _XYZ, "float"),
    "distance": Feature("dst", ("Z",), "float"),
    "motion": Feature("mot", ("X", "Y"), "float"),
    "normal": Feature("nrm", _XYZ),
    "albedo": Feature("alb", _RGB),
    "throughput": Feature("thr", _RGB),
    "roughness": Feature("rgh", ("Y",)),
    "coverage": Feature("cov", ("A",)),
}


def encode_frame(layers: Mapping[str, np.ndarray]) -> bytes:
    """Writes layers as one EXR file.

    A finite value beyond 65504 in a half layer is clamped to it (`health` counts them as `over_half`); NaN
    and infinity are kept, so that nothing is hidden. Layers that are not in `FEATURES` are stored as floats
    in a part of their own name with numbered channels.

    Args:
        layers: name to (height, width, channels) float32, all of one size.

    Returns:
        The file: scanline parts, ZIP compressed, each with a checksum of its pixels.

    Raises:
        FrameError: no layers, another shape or dtype, or a name that cannot be a part.
    """
    _check_layers(layers)
    parts = []
    for name, layer in layers.items():
        feature = FEATURES.get(name) or _generic(name, layer.shape[2])
        pixels = _to_half(layer) if feature.dtype == "half" else layer
        planes = [np.ascontiguousarray(pixels[..., index]) for index in range(layer.shape[2])]
        channels = dict(zip(_channels(feature), planes, strict=True))
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        header |= {_LAYER: name, _NUM_LAYERS: len(layers), _CHECKSUM: _checksum(channels)}
        parts.append(OpenEXR.Part(header, channels, feature.part))
    stream = io.BytesIO()
    OpenEXR.File(parts, num_threads=_NUM_THREADS).write(stream)
    return stream.getvalue()


def decode_frame(data: bytes) -> dict[str, np.ndarray]:
    """Reads what `encode_frame` wrote.

    Returns:
        Layer to (height, width, channels) float32, in the order they were given.

    Raises:
        FrameError: the bytes are no EXR file, one of another origin, or damaged.
    """
    try:
        parts = OpenEXR.File(io.BytesIO(data), separate_channels=True, num_threads=_NUM_THREADS).parts
        layers = dict(_decode_part(part) for part in parts)
        expected = max((part.header[_NUM_LAYERS] for part in parts), default=1)
    except FrameError:
        raise
    except Exception as error:  # the library raises RuntimeError, ValueError, UnicodeDecodeError, ...
        raise FrameError(
            f"frame must be an EXR file of ours, got {len(data)} bytes: {error}; render it again"
        ) from error
    if len(layers) != expected:  # the library drops parts that it cannot read
        raise FrameError(f"frame must have {expected} layers, got {list(layers)}; render it again")
    return layers


def health(layers: Mapping[str, np.ndarray]) -> dict[str, dict[str, int]]:
    """Counts the values of each layer that could harm what comes after it.

    Returns:
        Layer to counts of `nan`, `inf`, `negative` (finite or not) and `over_half` (finite, beyond +-65504).
    """
    return {name: _health(np.asarray(layer)) for name, layer in layers.items()}


def _health(layer: np.ndarray) -> dict[str, int]:
    finite = np.isfinite(layer)
    return {
        "nan": int(np.isnan(layer).sum()),
        "inf": int(np.isinf(layer).sum()),
        "negative": int((layer < 0).sum()),
        "over_half": int((finite & (np.abs(layer) > HALF_MAX)).sum()),
    }


def _decode_part(part: OpenEXR.Part) -> tuple[str, np.ndarray]:
    name = part.header.get(_LAYER)
    if name is None:
        raise FrameError(f"part must have the attribute {_LAYER}, got {part.name()!r} without; use encode_frame")
    arrays = {channel: content.pixels for channel, content in part.channels.items()}
    feature = FEATURES.get(name) or _generic(name, len(arrays))
    ordered = {channel: arrays[channel] for channel in _channels(feature)}
    if _checksum(ordered) != part.header[_CHECKSUM]:
        raise FrameError(f"layer {name} must match its checksum, got other pixels; render the frame again")
    return name, np.stack(list(ordered.values()), axis=-1).astype(np.float32, copy=False)


def _generic(name: str, num_channels: int) -> Feature:
    return Feature(name, tuple(f"{index:04d}" for index in range(num_channels)), "float")


def _channels(feature: Feature) -> list[str]:
    return [f"{feature.part}.{suffix}" for suffix in feature.channels]


def _to_half(layer: np.ndarray) -> np.ndarray:
    clamped = np.clip(layer, -HALF_MAX, HALF_MAX)
    return np.where(np.isfinite(layer), clamped, layer).astype(np.float16)


def _checksum(channels: Mapping[str, np.ndarray]) -> str:
    crc = 0
    for array in channels.values():
        crc = zlib.crc32(np.ascontiguousarray(array).data, crc)
    return f"{crc:08x}"


def _check_layers(layers: Mapping[str, np.ndarray]) -> None:
    if not layers:
        raise FrameError("frame must have at least one layer, got none; add a layer")
    size = next(iter(layers.values())).shape[:2]
    for name, layer in layers.items():
        if layer.ndim != 3 or layer.shape[:2] != size or 0 in layer.shape or layer.dtype != np.float32:
            raise FrameError(
                f"layer {name!r} must be float32 (height, width, channels) of the first layer's size {size}, "
                f"got {layer.dtype} {layer.shape}; convert it"
            )
        if name not in FEATURES:
            _check_generic_name(name)
        elif layer.shape[2] != len(FEATURES[name].channels):
            raise FrameError(
                f"layer {name!r} must have the channels {FEATURES[name].channels}, got {layer.shape[2]}; "
                "use another layer name"
            )


def _check_generic_name(name: str) -> None:
    taken = sorted(feature.part for feature in FEATURES.values())
    fits = name.isprintable() and 0 < len(name.encode()) <= _MAX_NAME_NBYTES
    if name in taken or not fits:
        raise FrameError(
            f"layer name must be 1 to {_MAX_NAME_NBYTES} bytes of printable text other than {taken}, "
            f"got {name!r}; rename it"
        )
