"""The HTML report: well formed, self-contained, every picture there, no scene's name run as HTML."""

import base64
import io
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from PIL import Image

from service.report import contact_sheet, data_uri, flip_pixels, picture_order, render_report

VOID = {"meta", "img", "br", "link", "input", "hr"}


class Page(HTMLParser):
    """Collects elements and text; fails on tags that do not match."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self._open: list[str] = []
        self.feed(html)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


def decode(uri: str | None) -> Image.Image:
    assert uri is not None
    head, _, payload = uri.partition(";base64,")
    picture = Image.open(io.BytesIO(base64.b64decode(payload, validate=True)))
    picture.load()
    assert head == f"data:image/{str(picture.format).lower()}"
    return picture


def test_every_picture_of_the_report_resolves(evaluation: Any) -> None:
    pictures = Page(render_report(evaluation)).all("img")
    assert len(pictures) == 4 + 3  # four frames, and a FLIP map of each but the reference
    for attributes in pictures:
        assert decode(attributes["src"]).size == (24, 16)
        assert (attributes["width"], attributes["height"]) == ("24", "16")
        assert attributes["alt"]


def test_report_needs_nothing_from_outside(evaluation: Any) -> None:
    page = Page(render_report(evaluation))
    assert page.all("link") == page.all("script") == []
    for _, attributes in page.elements:
        for name in ("src", "href"):
            assert (attributes.get(name) or "data:").startswith("data:")


def test_report_tells_scores_stages_settings_and_notes(evaluation: Any) -> None:
    text = " ".join(Page(render_report(evaluation, command="lightwell demo")).text.split())
    expected = ["≈34.25", "refused", "path tracing 1 spp + OIDN high", "1 min 30 s", "75 %", "3.0 MiB",
                "1.5 KiB", "33.00 dB", "0123456", "cpu: two cores", '"diffuse_spp": 256',
                "note: the reference was denoised", "lightwell demo", "2 min 00 s"]  # fmt: skip
    assert [words for words in expected if words not in text] == []


def test_report_refuses_the_score_of_a_row_with_non_finite_pixels(evaluation: Any) -> None:
    html = render_report(evaluation)
    assert "99.00" not in html
    assert html.count('class="refused"') == 6


def test_report_marks_one_best_value_a_column(evaluation: Any) -> None:
    evaluation.result["rows"] = evaluation.result["rows"][:2]
    for score in ("ssim", "st_lpips", "relmse", "temporal"):
        evaluation.result["rows"][1][score] = {"ssim": 0.8}.get(score, 0.5)
    assert render_report(evaluation).count('<td class="best">') == 7


def test_report_escapes_what_the_scene_says(evaluation: Any) -> None:
    evaluation.result["scene"] = evaluation.result["notes"][0] = "<script>alert(1)</script>"
    assert Page(render_report(evaluation)).all("script") == []


@pytest.mark.parametrize("missing", ["stages", "notes", "settings", "reference_error_db", "machine"])
def test_report_does_without_optional_parts(evaluation: Any, missing: str) -> None:
    del evaluation.result[missing]
    Page(render_report(evaluation))


def test_report_without_pictures_says_so(evaluation: Any) -> None:
    evaluation.pictures.clear()
    assert "kept no pictures" in Page(render_report(evaluation)).text


def test_large_pictures_are_embedded_as_jpeg() -> None:
    assert decode(data_uri(np.zeros((512, 512, 3), np.uint8))).format == "PNG"
    assert decode(data_uri(np.zeros((512, 513, 3), np.uint8))).format == "JPEG"


def test_flip_pixels_rise_from_dark_to_bright_and_clip() -> None:
    brightness = flip_pixels(np.array([[-1.0, 0.0, 0.5, 1.0, 2.0]], np.float32)).astype(int).sum(axis=-1)[0]
    assert brightness[0] == brightness[1] < brightness[2] < brightness[3] == brightness[4]


def test_picture_order_ends_with_the_reference() -> None:
    assert picture_order(["reference", "pt", "ours", "x", "ir"]) == ["ir", "ours", "pt", "x", "reference"]


def test_contact_sheet_sets_pictures_side_by_side(evaluation: Any) -> None:
    sheet = np.asarray(Image.open(io.BytesIO(contact_sheet(evaluation.pictures[0], ["ir", "reference"], gap_px=5))))
    assert sheet.shape == (16, 24 + 5 + 24, 3)
    assert (sheet[:, 24:29] == 255).all()
    assert sheet[8, 3].sum() > sheet[8, 32].sum()  # "ir" of the stand-in is four times as bright
