"""A small picture of a rendered frame, for people who watch a job."""

import numpy as np

from storage.errors import StorageError
from storage.layout import UnitRef
from storage.store import Store

FRAME_FILE = "frame.exr"
MAX_EDGE_PX = 512


def preview_png(store: Store, ref: UnitRef) -> bytes | None:
    """The denoised frame as PNG, exposed by itself, at most `MAX_EDGE_PX` wide and high; None if unreadable."""
    from models.metrics import exposure_from_luminance, luminance
    from service.images import display_image, encode_pixels
    from storage.frames import decode_frame

    try:
        layers = decode_frame(store.read(ref, FRAME_FILE))
    except StorageError:  # a preview is no reason to end a job; whoever needs the frame will say what is wrong
        return None
    radiance = layers.get("denoised", layers["radiance"])
    step = -(-max(radiance.shape[:2]) // MAX_EDGE_PX)
    small = np.ascontiguousarray(radiance[::step, ::step])
    finite = small[np.isfinite(small).all(axis=-1)]  # what is not is counted and told by the frame's own record
    exposure = exposure_from_luminance([luminance(finite)]) if finite.size else 1.0
    return encode_pixels(display_image(small, exposure))
