"""The load test of the issue: many clients, two scenes, small frames, a real `lightwell serve` process.

    python -m tests.load.frames --clients 64 --seconds 300 --size 320x180 [--bake] [--json out.json]

A store of two tiny scenes is made where none is given (some 15 s). The bare renderer, in a process of its own, and one
client take turns of a few seconds; then all clients ask at once. Every request asks for another pose: nothing is shared
or remembered. Exit code 1 where an answer was neither a frame nor a 503 with Retry-After, or memory grew by
more than `MAX_GROWTH` after the first minute.

`overhead_p50` sets against a bare frame's median time: one client's median request, and the median time between two
answers to all clients. The same for CPU time a frame, which does not depend on what else the machine does.
"""

import argparse
import asyncio
import json
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psutil

from tests.load.poses import poses
from tests.load.processes import baking, serving
from tests.load.processes import bare as bare_renderer
from tests.load.store import SCENES

MAX_GROWTH = 0.05
MAX_OVERHEAD = 0.15  # of the bare renderer, at the median, between two answers under load
SETTLED_S = 60.0
"""Memory counts from here on: the first minute sees every size, scene and cache for the first time."""
WIDTHS = "32,48,64"
"""The network of every preset but `tiny`: what users serve."""
WARM_S, TURN_S = 4.0, 5.0
METRICS = re.compile(r"lightwell_(frames|renders|queue|open|scenes|non_finite)\w*(?<!_created)[ {]|process_resident")
POSES_A_PHASE = 1_000_000
Memory = list[tuple[float, float]]
"""(seconds since the start, MiB) samples."""


class Load:
    """What the clients saw."""

    def __init__(self, url: str, size: tuple[int, int], accept: str, first_pose: int) -> None:
        self.url, self.size, self.accept = url, size, accept
        self._views = poses(first_pose, 1)  # one for all clients: none is asked for twice
        self.latencies_s: list[float] = []
        self.answered_s: list[float] = []
        self.steps_ms: dict[str, list[float]] = {}
        self.kinds: Counter[str] = Counter()

    async def client(self, http: httpx.AsyncClient, number: int, end_s: float) -> None:
        """One client: asks, waits for the answer, asks for the next; does as Retry-After says."""
        scenes = list(SCENES)
        while time.perf_counter() < end_s:
            number += 1
            body = next(self._views) | {"width": self.size[0], "height": self.size[1]}
            await self._ask(http, scenes[number % len(scenes)], body)

    async def _ask(self, http: httpx.AsyncClient, scene: str, body: dict[str, Any]) -> None:
        start_s = time.perf_counter()
        try:
            answer = await http.post(f"{self.url}/v1/scenes/{scene}/frame", json=body, headers={"Accept": self.accept})
        except httpx.HTTPError as error:
            self.kinds[type(error).__name__] += 1
            return
        end_s = time.perf_counter()
        if answer.status_code == 503 and answer.headers.get("Retry-After", "").isdigit():
            self.kinds["503 with Retry-After"] += 1
            await asyncio.sleep(int(answer.headers["Retry-After"]))
        elif answer.status_code == 200 and answer.headers["Content-Type"] == self.accept and answer.content:
            self.kinds["200"] += 1
            self.latencies_s.append(end_s - start_s)
            self.answered_s.append(end_s)
            for step in answer.headers["Server-Timing"].split(", "):
                name, _, value = step.partition(";dur=")
                self.steps_ms.setdefault(name, []).append(float(value))
        else:
            self.kinds[f"{answer.status_code} {answer.headers.get('X-Lightwell-Source', '')}".strip()] += 1

    def summary(self, cpu_s: float) -> dict[str, Any]:
        """Counts, quantiles in milliseconds, medians of the server's steps and of the time between answers.

        Args:
            cpu_s: CPU seconds of the service meanwhile.
        """
        return {
            "answers": dict(self.kinds),
            **quantiles_ms(self.latencies_s),
            "between_answers_p50_ms": round(1e3 * float(np.median(np.diff(sorted(self.answered_s)))), 3),
            "cpu_ms_a_frame": round(1e3 * cpu_s / len(self.answered_s), 2),
            "steps_p50_ms": {name: round(float(np.median(values)), 3) for name, values in self.steps_ms.items()},
        }


def quantiles_ms(seconds: list[float]) -> dict[str, float]:
    """p50, p95, p99 in milliseconds."""
    values = np.percentile(seconds, [50, 95, 99]) * 1e3
    return {name: round(float(value), 2) for name, value in zip(("p50_ms", "p95_ms", "p99_ms"), values, strict=True)}


async def watch_memory(process: psutil.Process, end_s: float, every_s: float = 5.0) -> Memory:
    """Resident memory until `end_s`."""
    start_s, samples = time.perf_counter(), []
    while time.perf_counter() < end_s:
        samples.append((time.perf_counter() - start_s, process.memory_info().rss / 2**20))
        await asyncio.sleep(every_s)
    return samples


async def run_clients(
    load: Load, num_clients: int, seconds: float, process: psutil.Process
) -> list[tuple[float, float]]:
    """All clients at once; returns the server's memory over time."""
    end_s = time.perf_counter() + seconds
    limits = httpx.Limits(max_connections=num_clients, max_keepalive_connections=num_clients)
    async with httpx.AsyncClient(limits=limits, timeout=120, trust_env=False) as http:
        watching = asyncio.create_task(watch_memory(process, end_s))
        await asyncio.gather(*(load.client(http, k, end_s) for k in range(num_clients)))
        return await watching


def growth(samples: Memory, settled_s: float) -> float:
    """Relative growth of memory from its first settled sample to the mean of its last fifth."""
    settled = [mib for second, mib in samples if second >= settled_s] or [mib for _, mib in samples]
    return float(np.mean(settled[-max(1, len(settled) // 5) :]) / settled[0] - 1.0)


class Bare:
    """The bare renderer's frames, taken in turns with what they are compared with."""

    def __init__(self, render: Callable[[float], dict[str, Any]]) -> None:
        self._render = render
        self.seconds: list[float] = []
        self.cpu_s = 0.0
        self.turn(WARM_S)
        self.seconds, self.cpu_s = [], 0.0

    def turn(self, seconds: float) -> None:
        """Renders for so long."""
        measured = self._render(seconds)
        self.seconds += measured["seconds"]
        self.cpu_s += measured["cpu_s"]

    def summary(self) -> dict[str, float]:
        """Quantiles, and CPU milliseconds a frame."""
        return {**quantiles_ms(self.seconds), "cpu_ms_a_frame": round(1e3 * self.cpu_s / len(self.seconds), 2)}


def cpu_seconds(process: psutil.Process) -> float:
    """User and system seconds of a process so far."""
    times = process.cpu_times()
    return float(times.user + times.system)


def measure(options: argparse.Namespace, store: str) -> dict[str, Any]:
    """The whole test; returns its figures."""
    width, height = map(int, options.size.split("x"))
    with ExitStack() as stack:
        if options.bake:
            stack.enter_context(baking())
        url, process = stack.enter_context(serving(store, list(SCENES)))
        bare = Bare(stack.enter_context(bare_renderer(store, options.size)))
        warm, alone, load = (Load(url, (width, height), options.accept, k * POSES_A_PHASE) for k in range(3))
        asyncio.run(run_clients(warm, 1, WARM_S, process))
        alone_cpu_s = -cpu_seconds(process)
        for _ in range(options.rounds):
            bare.turn(TURN_S)
            asyncio.run(run_clients(alone, 1, TURN_S, process))
        alone_cpu_s += cpu_seconds(process)
        load_cpu_s = -cpu_seconds(process)
        memory = asyncio.run(run_clients(load, options.clients, options.seconds, process))
        load_cpu_s += cpu_seconds(process)
        bare.turn(TURN_S)
        metrics = httpx.get(f"{url}/metrics", trust_env=False).text
    base, one, many = bare.summary(), alone.summary(alone_cpu_s), load.summary(load_cpu_s)
    return {
        "clients": options.clients, "widths": options.widths,
        "seconds": options.seconds, "size": options.size, "accept": options.accept,
        "bake_beside": options.bake, "bare": base, "one_client": one, "all_clients": many,
        "overhead_p50": {
            "latency_of_one_client": round(one["p50_ms"] / base["p50_ms"] - 1.0, 4),
            "time_between_answers_of_all": round(many["between_answers_p50_ms"] / base["p50_ms"] - 1.0, 4),
            "cpu_of_one_client": round(one["cpu_ms_a_frame"] / base["cpu_ms_a_frame"] - 1.0, 4),
            "cpu_of_all": round(many["cpu_ms_a_frame"] / base["cpu_ms_a_frame"] - 1.0, 4),
        },
        "rss_mib": [(round(second), round(mib, 1)) for second, mib in memory],
        "rss_growth_after_settling": round(growth(memory, min(SETTLED_S, options.seconds / 2)), 4),
        "metrics": [line for line in metrics.splitlines() if METRICS.match(line)],
    }  # fmt: skip


def failures(figures: dict[str, Any]) -> list[str]:
    """What the issue does not allow."""
    allowed = {"200", "503 with Retry-After"}
    wrong = {kind: count for kind, count in figures["all_clients"]["answers"].items() if kind not in allowed}
    found = [f"answers must be frames or 503 with Retry-After, got {wrong}"] if wrong else []
    if figures["rss_growth_after_settling"] > MAX_GROWTH:
        found.append(f"memory must be flat, grew by {100 * figures['rss_growth_after_settling']:.1f} %")
    overhead = figures["overhead_p50"]["time_between_answers_of_all"]
    if overhead > MAX_OVERHEAD:
        found.append(
            f"the service may take {100 * MAX_OVERHEAD:.0f} % over the bare renderer, got {100 * overhead:.1f}"
        )
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clients", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--size", default="320x180")
    parser.add_argument("--accept", default="image/png", choices=("image/png", "image/jpeg", "image/x-exr"))
    parser.add_argument("--rounds", type=int, default=4, help="turns of bare renderer and one client")
    parser.add_argument("--store", help="made there if it is not; default: a temporary folder")
    parser.add_argument("--widths", default=WIDTHS, help="of the networks that are trained for a new store")
    parser.add_argument("--bake", action="store_true", help="bake in another process meanwhile")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        store = options.store or folder
        subprocess.run([sys.executable, "-m", "tests.load.store", store, options.widths], check=True)
        figures = measure(options, store)
    text = json.dumps(figures, indent=1)
    print(text)
    if options.json:
        options.json.write_text(text + "\n")
    for sentence in failures(figures):
        print(sentence, file=sys.stderr)
    return 1 if failures(figures) else 0


if __name__ == "__main__":
    sys.exit(main())
