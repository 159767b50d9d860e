"""Previews of rendered frames: small, exposed by themselves, and never a reason to end a job."""

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from service.preview import FRAME_FILE, MAX_EDGE_PX, preview_png
from storage.frames import encode_frame
from storage.store import Store, UnitRef

REF = UnitRef("a" * 64, "render", "b" * 32)


def preview(folder: Path, **layers: np.ndarray) -> Image.Image:
    store = Store.open(folder / "store", create=True)
    store.commit(REF, {FRAME_FILE: encode_frame(layers)}, {})
    png = preview_png(store, REF)
    assert png is not None and png.startswith(b"\x89PNG")
    return Image.open(io.BytesIO(png))


def test_preview_is_of_the_denoised_frame_and_small(tmp_path: Path) -> None:
    noisy, calm = np.zeros((300, 1100, 3), np.float32), np.full((300, 1100, 3), 0.5, np.float32)
    picture = preview(tmp_path, radiance=noisy, denoised=calm)
    assert picture.size == (367, 100) and max(picture.size) <= MAX_EDGE_PX
    assert np.asarray(picture).min() > 100


@pytest.mark.parametrize("value", [np.inf, np.nan])
@pytest.mark.parametrize("share", [0.5, 1.0])
def test_preview_shows_a_frame_even_where_it_is_not_finite(tmp_path: Path, value: float, share: float) -> None:
    radiance = np.full((4, 6, 3), 0.5, np.float32)
    radiance[:, : int(6 * share)] = value
    pixels = np.asarray(preview(tmp_path, radiance=radiance))
    assert share == 1.0 or pixels[0, -1].min() > 100, "what is finite decides the exposure"


def test_preview_of_a_frame_that_is_not_there_is_none(tmp_path: Path) -> None:
    assert preview_png(Store.open(tmp_path / "store", create=True), REF) is None
