"""The choice of an operating point: the model of time, every demand, refusals, and the file at rest."""

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from storage.layout import tradeoff_file
from storage.store import Store
from storage.verification import find_problems, repair
from workers.errors import NoOperatingPointsError, OperatingPointError, UnreachableTargetError
from workers.operating_points import FrameDemand, FrameTime, OperatingPoint, choose, time_model
from workers.operating_table import OperatingTable, load_table, save_table

SIZES = ((320, 180), (640, 360), (1280, 720))


def times(fixed_ms: float, ms_per_megapixel: float) -> tuple[FrameTime, ...]:
    return tuple(FrameTime(width=w, height=h, ms=fixed_ms + ms_per_megapixel * w * h / 1e6) for w, h in SIZES)


def point(name: str, psnr: float, ms_per_megapixel: float, **values: Any) -> OperatingPoint:
    facts: dict[str, Any] = {
        "overrides": {"train.widths": [16, 16, 16]}, "network": "n1", "precision": "bf16", "scale": 1, "flip": 0.1,
        "temporal": None, "times": times(1.0, ms_per_megapixel), "bake_seconds": 3.0, "nbytes": 1000,
    }  # fmt: skip
    return OperatingPoint(name=name, psnr=psnr, **facts | values)


POINTS = [point("fast", 25.0, 10.0), point("slow and bad", 24.0, 50.0), point("middle", 31.5, 40.0),
          point("near best", 31.9, 90.0), point("finest", 32.0, 200.0)]  # fmt: skip


# ------------------------------------------------ the time model ------------------------------------------------


@given(st.floats(0.0, 100.0), st.floats(0.01, 1000.0))
def test_time_model_finds_the_line(fixed_ms: float, ms_per_megapixel: float) -> None:
    fixed, per_pixel, margin = time_model(times(fixed_ms, ms_per_megapixel))
    assert fixed == pytest.approx(fixed_ms, rel=1e-6, abs=1e-6)
    assert per_pixel == pytest.approx(ms_per_megapixel / 1e6, rel=1e-6)
    assert margin == pytest.approx(0.0, abs=1e-6)


def test_time_model_of_one_size_goes_through_the_origin() -> None:
    assert time_model([FrameTime(width=100, height=50, ms=10.0)]) == (0.0, 0.002, 0.0)


@given(st.lists(st.tuples(st.integers(1, 4000), st.floats(0.1, 1e4)), min_size=2, max_size=6))
def test_prediction_is_nowhere_below_a_measurement(measured: list[tuple[int, float]]) -> None:
    given_times = tuple(FrameTime(width=edge, height=edge, ms=ms) for edge, ms in measured)
    fixed, per_pixel, _ = time_model(given_times)
    assert fixed >= 0.0 and per_pixel >= 0.0
    one = point("any", 30.0, 1.0, times=given_times)
    assert all(one.predicted_ms(t.width, t.height) >= t.ms * (1 - 1e-9) for t in given_times)


def test_prediction_covers_the_spread_and_the_slowdown() -> None:
    spread = point("any", 30.0, 10.0, spread=0.2)
    typical = spread.typical_ms(640, 360)
    assert typical == pytest.approx(1.0 + 10.0 * 640 * 360 / 1e6)
    assert spread.predicted_ms(640, 360) == pytest.approx(1.2 * typical)
    assert spread.predicted_ms(640, 360, 1.1) == pytest.approx(1.2 * typical)  # the spread already holds it
    assert spread.predicted_ms(640, 360, 1.5) == pytest.approx(1.5 * typical)


def test_prediction_below_the_smallest_measured_size_is_that_size_s() -> None:
    smallest = SIZES[0]
    assert POINTS[0].predicted_ms(8, 8) == POINTS[0].predicted_ms(*smallest)
    assert POINTS[0].predicted_ms(8, 8) < POINTS[0].predicted_ms(*SIZES[1])


def test_points_of_older_tables_have_no_spread() -> None:
    value = POINTS[0].to_json()
    del value["spread"]
    assert OperatingPoint.from_json(value).spread == 0.0


# ------------------------------------------------- the choice -------------------------------------------------


@pytest.mark.parametrize(
    ("demand", "name"),
    [
        ({"quality": "draft"}, "fast"),
        ({"quality": "balanced"}, "middle"),
        ({"quality": "best"}, "finest"),
        ({"max_ms": 50.0}, "middle"),
        ({"max_ms": 1000.0}, "finest"),
        ({"min_psnr": 20.0}, "fast"),
        ({"min_psnr": 31.6}, "near best"),
        ({"max_ms": 1000.0, "min_psnr": 30.0}, "finest"),
        ({"max_ms": 1000.0, "min_psnr": 30.0, "quality": "draft"}, "middle"),
        ({"max_ms": 45.0, "quality": "draft"}, "fast"),
    ],
)
def test_choose_answers_the_demand(demand: dict[str, Any], name: str) -> None:
    assert choose(POINTS, FrameDemand(**demand), 1000, 1000).point.name == name


def test_choose_knows_the_size() -> None:
    demand = FrameDemand(max_ms=45.0)
    assert choose(POINTS, demand, 1000, 1000).point.name == "middle"
    assert choose(POINTS, demand, 400, 400).point.name == "finest"
    assert choose(POINTS, demand, 400, 400).ms == pytest.approx(33.0)


def test_choose_takes_a_faster_point_where_frames_are_slow() -> None:
    demand = FrameDemand(max_ms=45.0)
    assert [choose(POINTS, demand, 1000, 1000, slowdown).point.name for slowdown in (1.0, 1.2)] == ["middle", "fast"]
    with pytest.raises(UnreachableTargetError, match=r"in 55\.0 ms"):
        choose(POINTS, demand, 1000, 1000, 5.0)


@pytest.mark.parametrize(
    ("demand", "words", "nearest"),
    [
        ({"max_ms": 2.0}, "within 2 ms", {"best": "fast", "fastest": "fast"}),
        ({"min_psnr": 40.0}, "at least 40 dB", {"best": "finest", "fastest": "finest"}),
        ({"max_ms": 50.0, "min_psnr": 31.8}, "50 ms with at least 31.8", {"best": "middle", "fastest": "near best"}),
    ],
)
def test_choose_refuses_and_names_what_comes_nearest(
    demand: dict[str, Any], words: str, nearest: dict[str, str]
) -> None:
    with pytest.raises(UnreachableTargetError, match=words) as caught:
        choose(POINTS, FrameDemand(**demand), 1000, 1000)
    assert {key: value["point"] for key, value in caught.value.reachable.items()} == nearest
    assert all(name in str(caught.value) for name in nearest.values())


def test_choose_without_points_says_what_to_run() -> None:
    with pytest.raises(NoOperatingPointsError, match="lightwell tradeoff"):
        choose([], FrameDemand(quality="best"), 10, 10)


@pytest.mark.parametrize(
    "demand", [{}, {"quality": "great"}, {"max_ms": 0.0}, {"max_ms": float("nan")}, {"min_psnr": float("inf")}]
)
def test_demand_that_is_none_is_refused(demand: dict[str, Any]) -> None:
    with pytest.raises(OperatingPointError):
        FrameDemand(**demand)


# --------------------------------------------------- at rest ---------------------------------------------------


@pytest.fixture
def store(tmp_path: Path) -> Store:
    store = Store.open(tmp_path / "store", create=True)
    store.register_scene("d1", {"name": "one"})
    return store


def test_table_returns_from_the_store_as_it_went(store: Store) -> None:
    table = OperatingTable(base={"width": 64}, points=tuple(POINTS), result={"rows": []})
    save_table(store, "d1", table)
    assert load_table(store, "d1") == table
    assert table.point("middle").psnr == 31.5
    assert store.verify() == []
    assert store.scenes()[0]["name"] == "one"


def test_table_that_was_never_measured_says_what_to_run(store: Store) -> None:
    with pytest.raises(NoOperatingPointsError, match="lightwell tradeoff"):
        load_table(store, "d1")


@pytest.mark.parametrize("data", [b"{", b"[]", b"{}", b'{"schema": 99}', b'{"schema": 1, "base": {}, "points": [{}]}'])
def test_table_that_is_not_ours_is_named(store: Store, data: bytes) -> None:
    store.files.write(tradeoff_file("d1"), data)
    with pytest.raises(OperatingPointError, match=r"tradeoff\.json"):
        load_table(store, "d1")


def test_verify_finds_a_damaged_table_and_repair_takes_it_away(store: Store) -> None:
    save_table(store, "d1", OperatingTable(base={"width": 64}, points=tuple(POINTS), result={"rows": []}))
    whole = store.files.read(tradeoff_file("d1"))
    assert whole is not None
    store.files.write(tradeoff_file("d1"), whole.replace(b"31.5", b"91.5"))
    (problem,) = find_problems(store)
    assert "lightwell tradeoff" in problem.text
    with pytest.raises(OperatingPointError, match="checksum"):
        load_table(store, "d1")
    assert repair(store, problem)
    assert store.verify() == []
    with pytest.raises(NoOperatingPointsError):
        load_table(store, "d1")


def test_table_of_a_version_without_checksums_is_still_read(store: Store) -> None:
    table = OperatingTable(base={"width": 64}, points=tuple(POINTS), result={"rows": []})
    store.files.write(tradeoff_file("d1"), json.dumps(table.to_json()).encode())
    assert load_table(store, "d1") == table
    assert store.verify() == []


def test_point_of_an_unknown_name_lists_the_known() -> None:
    table = OperatingTable(base={}, points=tuple(POINTS[:2]), result={})
    with pytest.raises(OperatingPointError, match="fast, slow and bad"):
        table.point("other")
