"""How rows are read: refused scores, best of a column, the reference's own noise, sizes and times."""

import pytest

from service import scores

PSNR, FLIP, MS = (next(c for c in scores.COLUMNS if c.key == key) for key in ("psnr", "flip", "ms"))


def test_a_row_with_non_finite_pixels_has_no_scores_but_a_time() -> None:
    row = {"psnr": 50.0, "ms": 3.0, "non_finite": 1}
    assert scores.text(row, PSNR) == scores.REFUSED
    assert scores.text(row, MS) == "3.0"


def test_best_ignores_refused_and_absent_rows() -> None:
    rows = [
        {"psnr": 20.0},
        {"psnr": 25.0},
        {"psnr": 99.0, "non_finite": 2},
        {"psnr": None},
        {"psnr": float("nan")},
    ]
    assert scores.best(rows, PSNR) == 25.0
    assert [scores.is_best(row, PSNR, rows) for row in rows] == [False, True, False, False, False]


def test_best_is_the_least_where_lower_is_better() -> None:
    rows = [{"flip": 0.2}, {"flip": 0.1}]
    assert scores.best(rows, FLIP) == 0.1
    assert scores.best([{"flip": None}], FLIP) is None


def test_rows_that_read_the_same_are_both_best() -> None:
    rows = [{"psnr": 30.001}, {"psnr": 30.002}, {"psnr": 29.9}]
    assert [scores.is_best(row, PSNR, rows) for row in rows] == [True, True, False]


def test_psnr_above_the_reference_own_noise_is_marked() -> None:
    assert scores.text({"psnr": 36.0}, PSNR, 35.0) == "≈36.00"
    assert scores.text({"psnr": 34.0}, PSNR, 35.0) == "34.00"
    assert scores.text({"flip": 36.0}, FLIP, 35.0) == "36.0000"
    assert scores.text({"psnr": 36.0}, PSNR, None) == "36.00"


def test_missing_score_is_absent() -> None:
    assert scores.text({}, PSNR) == scores.text({"psnr": float("inf")}, PSNR) == scores.ABSENT


@pytest.mark.parametrize(
    ("name", "title"),
    [
        ("ours", "ours (caches + network)"),
        ("pt-16", "path tracing 16 spp"),
        ("pt-1+oidn-fast", "path tracing 1 spp + OIDN fast"),
        ("pt-x", "pt-x"),
        ("reference", "reference"),
    ],
)
def test_method_title_says_what_was_done(name: str, title: str) -> None:
    assert scores.method_title(name) == title


@pytest.mark.parametrize(
    ("num_bytes", "text"),
    [(0, "0 B"), (1023, "1023 B"), (1536, "1.5 KiB"), (3 * 2**30, "3.0 GiB"), (2**52, "4096.0 TiB")],
)
def test_human_bytes(num_bytes: int, text: str) -> None:
    assert scores.human_bytes(num_bytes) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.42, "0.42 s"), (12, "12.0 s"), (59.96, "60.0 s"), (185, "3 min 05 s"), (7620, "2 h 07 min")],
)
def test_human_seconds(seconds: float, text: str) -> None:
    assert scores.human_seconds(seconds) == text
