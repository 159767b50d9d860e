"""The check of `max_ms` (`tests/load/max_ms.py`): what it asks for, what it counts, when it fails."""

from typing import Any

import numpy as np
import pytest

from tests.load.max_ms import HIGHEST, LOWEST, NUM_SIZES, Answer, ask, demands, failures, summary
from workers.operating_points import FrameTime, OperatingPoint


def point(name: str, ms: float) -> OperatingPoint:
    times = tuple(FrameTime(width=w, height=w, ms=ms * w / 100) for w in (100, 400))
    return OperatingPoint(
        name=name, overrides={}, network=None, precision="fp32", scale=1, psnr=30.0, flip=None, temporal=None,
        times=times, bake_seconds=1.0, nbytes=1, spread=0.1,
    )  # fmt: skip


POINTS = (point("fast", 4.0), point("slow", 20.0))


def answer(ratio: float, **values: Any) -> Answer:
    facts: dict[str, Any] = {"status": 200, "width": 10, "height": 10, "max_ms": 10.0, "point": "fast"}
    times = {"promised_ms": 10.0 * ratio, "server_ms": 11.0 * ratio, "client_ms": 15.0 * ratio}
    return Answer(**facts | times | values)


def test_demands_mix_sizes_and_limits_around_what_is_reachable() -> None:
    asked = list(demands(POINTS, 300, seed=1))
    assert asked == list(demands(POINTS, 300, seed=1)) != list(demands(POINTS, 300, seed=2))
    sizes = {(width, height) for width, height, _ in asked}
    assert NUM_SIZES // 2 < len(sizes) <= NUM_SIZES
    assert all(0.95 * 100**2 < width * height < 1.05 * 400**2 for width, height in sizes)
    for width, height, max_ms in asked:
        times = [each.predicted_ms(width, height) for each in POINTS]
        assert LOWEST * min(times) * 0.999 < max_ms < HIGHEST * max(times) * 1.001
    refused = np.mean([max_ms < POINTS[0].predicted_ms(width, height) for width, height, max_ms in asked])
    assert 0.02 < refused < 0.5  # some of each kind


def test_summary_counts_refused_ones_apart() -> None:
    answers = [answer(0.9)] * 15 + [answer(1.1)] * 3 + [answer(1.3)] + [answer(0.0, status=422, point="")] * 4
    figures = summary(answers)
    assert (figures["requests"], figures["answered"], figures["refused"]) == (23, 19, 4)
    assert figures["share_beyond_max_ms"] == round(4 / 19, 4)
    assert figures["share_beyond_120_percent"]["promised"] == round(1 / 19, 4)
    assert figures["share_beyond_120_percent"]["client, all"] == 1.0
    assert figures["points"] == {"fast": 19}


@pytest.mark.parametrize(
    ("answers", "words"),
    [
        ([answer(0.9)] * 19 + [answer(1.3)], None),  # 5 %
        ([answer(0.9)] * 18 + [answer(1.3)] * 2, "got 10.0 %"),
        ([answer(0.9)] * 30 + [answer(0.0, status=500)], "got {'500': 1}"),
        ([answer(0.9)] * 4 + [answer(0.0, status=422)] * 6, "got 4 of 10"),
        ([answer(0.0, status=422)], "got none"),
    ],
)
def test_check_fails_where_the_promise_is_broken(answers: list[Answer], words: str | None) -> None:
    found = failures(summary(answers))
    assert found == [] if words is None else words in "; ".join(found)


def test_answer_is_read_from_the_headers() -> None:
    class Http:
        def post(self, url: str, **_: Any) -> Any:
            steps = "queue;dur=1.00, prepare;dur=80.00, query;dur=3.00, network;dur=4.50, encode;dur=2.00"
            headers = {"Server-Timing": steps, "X-Lightwell-Point": "fine"}
            return type("Response", (), {"status_code": 200, "headers": headers})()

    http: Any = Http()
    got = ask(http, "url", {"width": 8, "height": 6, "max_ms": 7.0})
    assert (got.promised_ms, got.server_ms, got.prepared, got.point) == (7.5, 90.5, True, "fine")
