"""Wall times that may be compared, and what the machine can compute at most.

Methods that are compared are timed interleaved: each round times every one once, so that a slow phase of the
machine hits all alike, and medians count. Each is timed right after a run of its own that does not count: a round takes
seconds, after which the first query and the first network run took up to 7 times as long on a machine that reclaims
idle memory.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache

import numpy as np
import psutil
import torch

from workers.progress import Progress

MATMUL_EDGE = 2048
MATMUL_SMALLEST = 256
MATMUL_SECONDS = 0.02
MATMUL_REPEATS = 4
# Of fp32's time. With instructions of its own bfloat16 takes less than once, without them a hundred times; beside
# another process, which may hold a core all through so short a measurement, either may seem to take several times as
# long.
BF16_WORST = 20.0


def interleaved_medians(
    methods: dict[str, Callable[[int], object]], repeats: int, progress: Progress, description: str
) -> dict[str, float]:
    """Median wall seconds of each method; arguments as `interleaved_seconds`."""
    rounds = interleaved_seconds(methods, repeats, progress, description)
    return {name: float(np.median(values)) for name, values in rounds.items()}


def interleaved_seconds(
    methods: dict[str, Callable[[int], object]], repeats: int, progress: Progress, description: str
) -> dict[str, list[float]]:
    """Wall seconds of each method in every round.

    Args:
        methods: name to function of the round's index, from 0 on; each must return only when its work is done.
        repeats: rounds, at least 1.
        progress: told round by round.
        description: for the progress.
    """
    times: dict[str, list[float]] = {name: [] for name in methods}
    with progress.track(description, repeats) as advance:
        for index in range(repeats):
            for name, method in methods.items():
                method(index)
                start = time.perf_counter()
                method(index)
                times[name].append(time.perf_counter() - start)
            advance()
    return times


def spread_of(rounds: Iterable[Sequence[float]], share: float = 0.95) -> float:
    """How far above the median of the other rounds one round lies, at most, in `share` of the cases.

    Rounds of several methods are pooled: few repeats of one tell nothing of its tail.

    Args:
        rounds: seconds of each method; those with fewer than two rounds are left out.
        share: quantile, in (0, 1).

    Returns:
        Relative excess, >= 0; 0 where there is nothing to tell it from.
    """
    ratios = [
        seconds / np.median([*values[:index], *values[index + 1 :]])
        for values in rounds
        if len(values) > 1
        for index, seconds in enumerate(values)
    ]
    return max(0.0, float(np.quantile(ratios, share)) - 1.0) if ratios else 0.0


@contextmanager
def other_load() -> Iterator[dict[str, float]]:
    """Measures what else ran meanwhile: times taken on a busy machine are too long.

    Yields:
        A dict that holds "other_cpus" (mean number of CPU threads that others than this process and its children
        kept busy) and "cpus" once the block has ended.
    """
    load: dict[str, float] = {}
    own = psutil.Process()
    busy, mine, wall = _busy_seconds(psutil.cpu_times()), _family_seconds(own), time.perf_counter()
    yield load
    elapsed = max(time.perf_counter() - wall, 1e-9)
    others = _busy_seconds(psutil.cpu_times()) - busy - (_family_seconds(own) - mine)
    load |= {"other_cpus": max(others, 0.0) / elapsed, "cpus": float(psutil.cpu_count() or 1)}


def _family_seconds(process: psutil.Process) -> float:
    """CPU seconds of a process, of its children that live, and of those that ended."""
    seconds = sum(process.cpu_times()[:4])  # user, system, and the same of ended children
    for child in process.children():
        with suppress(psutil.NoSuchProcess):
            seconds += _family_seconds(child)
    return seconds


def _busy_seconds(times: object) -> float:
    return sum(getattr(times, name, 0.0) for name in ("user", "nice", "system", "irq", "softirq", "steal"))


def matmul_gflop_per_s(dtype: torch.dtype, device: torch.device, edge: int = MATMUL_EDGE) -> float:
    """Best rate of a few products of two square matrices, GFLOP/s (a multiply-add is 2).

    Their edge doubles up to `edge` while a product takes less than `MATMUL_SECONDS`: a CPU without bfloat16
    instructions would take minutes for a large one.
    """
    size = min(MATMUL_SMALLEST, edge)
    while True:
        seconds = _matmul_seconds(dtype, device, size)
        if size >= edge or seconds > MATMUL_SECONDS:
            return 2.0 * size**3 / seconds / 1e9
        size = min(2 * size, edge)


def _matmul_seconds(dtype: torch.dtype, device: torch.device, edge: int) -> float:
    a, b = (torch.rand(edge, edge, device=device).to(dtype) for _ in range(2))
    times = []
    for _ in range(MATMUL_REPEATS + 1):
        start = time.perf_counter()
        product = a @ b
        if product.is_cuda:
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return min(times[1:])


@lru_cache(maxsize=4)
def bf16_is_fast(device: torch.device) -> bool:
    """Whether bfloat16 is worth trying on a device: without instructions for it, trying it on a frame or a training
    step of a CPU takes minutes."""
    fp32, bf16 = (_matmul_seconds(dtype, device, MATMUL_SMALLEST) for dtype in (torch.float32, torch.bfloat16))
    return bf16 < BF16_WORST * fp32
