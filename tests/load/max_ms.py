"""Whether `max_ms` is kept: requests of mixed sizes and limits against a real `lightwell serve` process.

    lightwell tradeoff tiny --store DIR --preset tiny
    python -m tests.load.max_ms DIR --scene tiny [--requests 200] [--seed 1] [--json out.json]

The store must hold the scene's operating points. Sizes lie between the smallest and the largest that the sweep timed;
limits between 0.7 of what the fastest point is predicted to take and 1.5 of what the slowest is, both on log scales,
from a fixed seed. No two requests share a frame. One client asks, one request after the other.

What is promised is the time from pose to frame in memory: the "query" and "network" steps of Server-Timing. Reported
beside it are all of the server's steps and the client's own wall time, for requests that had to prepare nothing and
for all. Requests that no point can meet are refused (422) and counted apart. Exit code 1 where more than 5 % of the
answered requests exceed their limit by more than 20 %, or fewer than half are answered.
"""

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np

import workers  # noqa: F401  # thread policy, before anything imports torch
from service.frame_choice import FRAME_STEPS
from storage.store import Store
from tests.load.processes import serving
from workers.operating_points import OperatingPoint
from workers.operating_table import load_table
from workers.progress import Progress
from workers.renderer import open_run

ALLOWED_EXCESS = 0.2
ALLOWED_SHARE = 0.05
MIN_ANSWERED = 0.5
LOWEST, HIGHEST = 0.7, 1.5
NUM_SIZES = 12
FOV_STEP = 1e-5
"""Relative change of the field of view from one request to the next: no frame is asked for twice."""


@dataclass(frozen=True)
class Answer:
    """One request's fate.

    Attributes:
        status: of HTTP.
        max_ms: what was asked for.
        promised_ms: query and network.
        server_ms: all steps.
        client_ms: as the client saw it.
        prepared: whether something was opened or compiled for it.
        point: that made the frame, "" where refused.
    """

    status: int
    width: int
    height: int
    max_ms: float
    promised_ms: float = 0.0
    server_ms: float = 0.0
    client_ms: float = 0.0
    prepared: bool = False
    point: str = ""


def demands(points: Sequence[OperatingPoint], count: int, seed: int) -> Iterator[tuple[int, int, float]]:
    """(width, height, max_ms) of each request, mixed as this module's first lines say."""
    rng = np.random.default_rng(seed)
    measured = sorted({(t.width * t.height, t.width, t.height) for point in points for t in point.times})
    (fewest, *_), (most, *_) = measured[0], measured[-1]
    sizes = []
    for pixels in np.exp(rng.uniform(np.log(fewest), np.log(most), NUM_SIZES)):
        aspect = rng.choice([1.0, 4 / 3, 16 / 9])
        sizes.append((max(1, round(np.sqrt(pixels * aspect))), max(1, round(np.sqrt(pixels / aspect)))))
    for _ in range(count):
        width, height = sizes[rng.integers(NUM_SIZES)]
        times = [point.predicted_ms(width, height) for point in points]
        yield width, height, float(np.exp(rng.uniform(np.log(LOWEST * min(times)), np.log(HIGHEST * max(times)))))


def ask(http: httpx.Client, url: str, body: dict[str, Any]) -> Answer:
    """Posts one request."""
    start_s = time.perf_counter()
    response = http.post(url, json=body, headers={"Accept": "image/jpeg"})
    client_ms = 1e3 * (time.perf_counter() - start_s)
    asked = (response.status_code, body["width"], body["height"], body["max_ms"])
    if response.status_code != 200:
        return Answer(*asked)
    parts = (step.partition(";dur=") for step in response.headers["Server-Timing"].split(", "))
    steps = {name: float(value) for name, _, value in parts}
    return Answer(
        *asked, promised_ms=sum(steps[name] for name in FRAME_STEPS), server_ms=sum(steps.values()),
        client_ms=client_ms, prepared=bool({"prepare", "open"} & steps.keys()),
        point=response.headers["X-Lightwell-Point"],
    )  # fmt: skip


def summary(answers: Sequence[Answer]) -> dict[str, Any]:
    """Counts, and the shares that exceed their limit by more than `ALLOWED_EXCESS`."""
    served = [answer for answer in answers if answer.status == 200]
    steady = [answer for answer in served if not answer.prepared]
    return {
        "requests": len(answers), "answered": len(served), "refused": sum(a.status == 422 for a in answers),
        "failed": dict(Counter(str(a.status) for a in answers if a.status not in (200, 422))),
        "prepared": len(served) - len(steady),
        "sizes": len({(a.width, a.height) for a in answers}), "points": dict(Counter(a.point for a in served)),
        "share_beyond_max_ms": share_beyond(served, "promised_ms", 0.0),
        "share_beyond_120_percent": {
            "promised": share_beyond(served, "promised_ms"),
            "server, nothing prepared": share_beyond(steady, "server_ms"),
            "client, nothing prepared": share_beyond(steady, "client_ms"),
            "client, all": share_beyond(served, "client_ms"),
        },
        "promised_over_max_ms": quantiles([a.promised_ms / a.max_ms for a in served]),
    }  # fmt: skip


def share_beyond(answers: Sequence[Answer], time_name: str, excess: float = ALLOWED_EXCESS) -> float | None:
    """Share whose time is more than (1 + excess) of its limit; None of no answers."""
    late = [getattr(answer, time_name) > (1.0 + excess) * answer.max_ms for answer in answers]
    return round(float(np.mean(late)), 4) if late else None


def quantiles(values: Sequence[float]) -> dict[str, float]:
    """Quantiles in percent to values."""
    return {f"p{q}": round(float(np.percentile(values, q)), 3) for q in (5, 50, 95, 99)} if values else {}


def failures(figures: dict[str, Any]) -> list[str]:
    """What the issue does not allow."""
    found = []
    if figures["failed"]:
        found.append(f"answers must be frames or refusals (422), got {figures['failed']}")
    if figures["answered"] < MIN_ANSWERED * figures["requests"]:
        found.append(f"half of the requests must be answered, got {figures['answered']} of {figures['requests']}")
    late = figures["share_beyond_120_percent"]["promised"]
    if late is None:
        found.append("some request must be answered, got none")
    elif late > ALLOWED_SHARE:
        found.append(f"at most {100 * ALLOWED_SHARE:g} % may exceed max_ms by more than 20 %, got {100 * late:.1f} %")
    return found


def measure(options: argparse.Namespace) -> tuple[dict[str, Any], list[Answer]]:
    """The whole test: its figures and every answer."""
    store = Store.open(options.store)
    entry = store.find_scene(options.scene)
    points = load_table(store, entry["digest"]).points
    run, _ = open_run(store, entry, Progress())
    cameras = [*run.paths.train, *run.paths.test]
    answers = []
    with serving(options.store, [entry["digest"]]) as (url, _), httpx.Client(timeout=300, trust_env=False) as http:
        for index, (width, height, max_ms) in enumerate(demands(points, options.requests, options.seed)):
            camera = cameras[index % len(cameras)]
            body = {
                "camera": {"to_world": camera.to_world.tolist()}, "fov_deg": camera.fov_deg * (1 - FOV_STEP * index),
                "width": width, "height": height, "max_ms": max_ms,
            }  # fmt: skip
            answers.append(ask(http, f"{url}/v1/scenes/{entry['digest']}/frame", body))
    return {"scene": entry["name"], "seed": options.seed, **summary(answers)}, answers


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store", help="with the scene's operating points, from `lightwell tradeoff`")
    parser.add_argument("--scene", default="tiny", help="name or digest")
    parser.add_argument("--requests", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, help="also write figures and answers here")
    options = parser.parse_args()
    figures, answers = measure(options)
    print(json.dumps(figures, indent=1))
    if options.json:
        everything = figures | {"answers": [asdict(answer) for answer in answers]}
        options.json.write_text(json.dumps(everything, indent=1) + "\n")
    for sentence in failures(figures):
        print(sentence, file=sys.stderr)
    return 1 if failures(figures) else 0


if __name__ == "__main__":
    sys.exit(main())
