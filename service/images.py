"""Radiance to the bytes of a picture file, and which kind of file a client asked for.

Radiance is [height, width, 3] float32, linear, Rec.709 primaries, row 0 on top. PNG and JPEG show
`srgb(clip(exposure * radiance, 0, 1))` in 8 bits, as the metrics see it; EXR keeps the radiance itself.
"""

import functools
import io
import zlib
from collections.abc import Sequence
from pathlib import PurePath

import numpy as np
from numpy.typing import NDArray

from service.errors import NotAcceptableError, OptionError

PNG, JPEG, EXR = "image/png", "image/jpeg", "image/x-exr"
MEDIA_TYPES = (PNG, JPEG, EXR)
"""What `encode` writes, the preferred one first."""

MEDIA_TYPE_OF_SUFFIX = {".png": PNG, ".jpg": JPEG, ".jpeg": JPEG, ".exr": EXR}
JPEG_QUALITY = 93
_TABLE_MAX = 65535
NON_FINITE_COLOUR = (255, 0, 255)
"""Pixels that hold NaN or infinity are shown in magenta: a picture must not hide them."""


def display_image(radiance: NDArray[np.float32], exposure: float) -> NDArray[np.uint8]:
    """What a screen shows of linear radiance.

    Args:
        radiance: [height, width, 3] linear scene radiance.
        exposure: the scene's factor from radiance to display light, > 0.

    Returns:
        [height, width, 3] sRGB in 8 bits, rounded to nearest; NaN and infinity in `NON_FINITE_COLOUR`.
    """
    if np.isfinite(radiance).all():  # by far the usual case, and several times faster
        return _eight_bits(radiance, exposure)
    finite: NDArray[np.bool_] = np.asarray(np.isfinite(radiance).all(axis=-1))
    pixels = _eight_bits(np.where(finite[..., None], radiance, 0).astype(np.float32), exposure)
    pixels[~finite] = NON_FINITE_COLOUR
    return pixels


def _eight_bits(radiance: NDArray[np.float32], exposure: float) -> NDArray[np.uint8]:
    """`models.metrics.tone_map` in 8 bits, by a table of 16-bit linear values.

    Rounded to nearest but for values within 0.03 of the middle between two levels. A table on one thread: the curve's
    powers took 20 times as long beside a renderer that uses every core.
    """
    scale = np.float32(min(exposure * _TABLE_MAX, 1e38))
    with np.errstate(over="ignore"):  # infinitely bright is white
        linear = np.multiply(radiance, scale, dtype=np.float32)
    np.clip(linear, 0.0, _TABLE_MAX, out=linear)
    linear += np.float32(0.5)
    return _display_table()[linear.astype(np.uint16)]


@functools.cache
def _display_table() -> NDArray[np.uint8]:
    from models.metrics import tone_map

    display = tone_map(np.arange(_TABLE_MAX + 1, dtype=np.float32) / np.float32(_TABLE_MAX), 1.0)
    return np.rint(display * np.float32(255.0)).astype(np.uint8)


def encode_pixels(pixels: NDArray[np.uint8], media_type: str = PNG) -> bytes:
    """[height, width, 3] sRGB in 8 bits as the bytes of a PNG or JPEG file."""
    from PIL import Image

    buffer = io.BytesIO()
    image = Image.fromarray(pixels)
    if media_type == JPEG:
        image.save(buffer, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    else:
        # Run lengths: smaller on rendered frames than zlib's default strategy at level 3, in two thirds of the time.
        image.save(buffer, "PNG", compress_level=1, compress_type=zlib.Z_RLE)
    return buffer.getvalue()


def encode(radiance: NDArray[np.float32], exposure: float, media_type: str) -> bytes:
    """A frame as the bytes of a file of `media_type`, one of `MEDIA_TYPES`.

    Args:
        radiance: [height, width, 3] float32 linear scene radiance.
        exposure: used by PNG and JPEG, ignored by EXR.
        media_type: one of `MEDIA_TYPES`.
    """
    if media_type == EXR:
        from storage.frames import encode_frame

        return encode_frame({"radiance": np.ascontiguousarray(radiance, dtype=np.float32)})
    return encode_pixels(display_image(radiance, exposure), media_type)


def media_type_of(path: str | PurePath) -> str:
    """The media type that a file name asks for.

    Raises:
        OptionError: the suffix is none of .png, .jpg, .jpeg and .exr.
    """
    suffix = PurePath(path).suffix.lower()
    if suffix not in MEDIA_TYPE_OF_SUFFIX:
        raise OptionError(
            f"output file must end in {', '.join(MEDIA_TYPE_OF_SUFFIX)}, got {str(path)!r}; change its suffix"
        )
    return MEDIA_TYPE_OF_SUFFIX[suffix]


def _quality(accepted: str) -> tuple[str, float]:
    """One element of an Accept header as (media range, q); a q that is no number in 0..1 counts as 0."""
    media_range, *parameters = (part.strip() for part in accepted.split(";"))
    quality = 1.0
    for parameter in parameters:
        name, _, value = parameter.partition("=")
        if name.strip().lower() == "q":
            try:
                quality = float(value)
            except ValueError:
                quality = 0.0
    return media_range.lower(), quality if 0.0 <= quality <= 1.0 else 0.0


def negotiate(accept: str | None, media_types: Sequence[str] = MEDIA_TYPES) -> str:
    """Which of `media_types` answers an Accept header (RFC 9110, section 12.5.1).

    The most specific range that names a type gives its quality; equal qualities fall to the order of
    `media_types`. No header, or an empty one, accepts everything.

    Raises:
        NotAcceptableError: every type has quality 0.
    """
    if accept is None or not accept.strip():
        return media_types[0]
    qualities = dict(_quality(element) for element in accept.split(",") if element.strip())

    def quality_of(media_type: str) -> float:
        for media_range in (media_type, media_type.split("/")[0] + "/*", "*/*"):
            if media_range in qualities:
                return qualities[media_range]
        return 0.0

    best = max(media_types, key=quality_of)
    if quality_of(best) <= 0.0:
        raise NotAcceptableError(f"Accept must allow one of {', '.join(media_types)}, got {accept!r}")
    return best
