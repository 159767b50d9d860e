"""The trade plot: who is beaten by nobody, logarithmic time, labels that cover nothing."""

from itertools import pairwise

import pytest

from service import plot


def result(*rows: tuple[str, float | None, float | None], reference: float | None = None) -> dict:
    return {
        "rows": [{"name": name, "ms": ms, "psnr": psnr, "non_finite": 0} for name, ms, psnr in rows],
        "reference_error_db": reference,
    }


def test_best_trades_are_those_that_nobody_beats_in_both() -> None:
    measured = {
        "a": (1.0, 20.0),
        "b": (2.0, 30.0),
        "worse": (3.0, 25.0),
        "slow": (2.5, 30.0),
        "c": (9.0, 31.0),
    }
    assert plot.best_trades(measured) == {"a", "b", "c"}


def test_equal_rows_are_both_best() -> None:
    assert plot.best_trades({"a": (1.0, 20.0), "b": (1.0, 20.0)}) == {"a", "b"}


def test_time_is_logarithmic_and_psnr_linear() -> None:
    drawn = plot.trade_plot(result(("a", 1.0, 10.0), ("b", 10.0, 20.0), ("c", 100.0, 30.0)))
    assert drawn is not None
    a, b, c = sorted(drawn.points, key=lambda point: point.name)
    assert b.x - a.x == pytest.approx(c.x - b.x)
    assert a.y - b.y == pytest.approx(b.y - c.y)
    assert a.x < c.x and c.y < a.y


def test_every_point_and_tick_lies_inside_the_frame() -> None:
    drawn = plot.trade_plot(result(("a", 0.013, 3.0), ("b", 7000.0, 61.0), reference=40.0))
    assert drawn is not None
    xs = [point.x for point in drawn.points] + [tick.at for tick in drawn.x_ticks]
    ys = [point.y for point in drawn.points] + [tick.at for tick in drawn.y_ticks] + [drawn.reference_y]
    assert min(xs) >= plot.LEFT and max(xs) <= plot.WIDTH - plot.RIGHT
    assert min(ys) >= plot.TOP and max(ys) <= plot.HEIGHT - plot.BOTTOM


@pytest.mark.parametrize("psnrs", [[30.0] * 14, [30.0 + k / 100 for k in range(14)], [10.0] * 7 + [40.0] * 7])
def test_labels_do_not_cover_each_other(psnrs: list[float]) -> None:
    drawn = plot.trade_plot(result(*((f"m{k}", 1.0 + k, psnr) for k, psnr in enumerate(psnrs))))
    assert drawn is not None
    heights = sorted(point.label_y for point in drawn.points)
    assert min(b - a for a, b in pairwise(heights)) >= plot.LABEL_HEIGHT - 1e-9
    assert heights[0] >= 0 and heights[-1] <= plot.HEIGHT - plot.BOTTOM + 1e-9


def test_rows_without_both_numbers_are_left_out() -> None:
    drawn = plot.trade_plot(result(("a", 1.0, 10.0), ("b", 2.0, 20.0), ("c", None, 30.0), ("d", 4.0, None)))
    assert drawn is not None and {point.name for point in drawn.points} == {"a", "b"}
    assert plot.trade_plot(result(("a", 1.0, 10.0), ("c", None, 30.0))) is None


def test_reference_line_is_drawn_only_inside() -> None:
    rows = (("a", 1.0, 10.0), ("b", 2.0, 20.0))
    assert plot.trade_plot(result(*rows, reference=15.0)).reference_y is not None
    assert plot.trade_plot(result(*rows, reference=60.0)).reference_y is None
