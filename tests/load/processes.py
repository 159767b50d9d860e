"""The processes of a load test: the service itself, and a bake beside it. Each ends with its block."""

import json
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import httpx
import psutil

START_S = 120.0
BAKE = ["--preset", "draft", "--resolution", "256x256", "--set", "cache.diffuse_spp=16384",
        "--set", "cache.directional_spp=64"]  # fmt: skip
"""Minutes of work: it must not end before the test does."""


@contextmanager
def serving(store: str, preload: Sequence[str]) -> Iterator[tuple[str, psutil.Process]]:
    """A `lightwell serve` on a free port, once /readyz says so.

    Yields:
        Its URL and its process.

    Raises:
        RuntimeError: it is not ready in time, or ended.
    """
    command = [sys.executable, "-m", "service.cli", "serve", "--store", store, "--port", "0"]
    command += [word for name in preload for word in ("--preload", name)]
    with _running(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        assert process.stderr is not None
        url, lines = None, []
        for line in process.stderr:
            lines.append(line)
            if match := re.search(r" on (http://\S+) ", line):
                url = match[1]
                break
        if url is None:
            raise RuntimeError(f"service must start, got: {''.join(lines)}")
        threading.Thread(target=lambda stream: [None for _ in stream], args=(process.stderr,), daemon=True).start()
        deadline_s = time.monotonic() + START_S
        while not _is_ready(url):
            if time.monotonic() > deadline_s or process.poll() is not None:
                raise RuntimeError(f"service must be ready within {START_S:.0f} s, got exit code {process.poll()}")
            time.sleep(0.2)
        yield url, psutil.Process(process.pid)


def _is_ready(url: str) -> bool:
    try:
        return httpx.get(f"{url}/readyz", trust_env=False).status_code == 200
    except httpx.TransportError:
        return False


@contextmanager
def bare(store: str, size: str) -> Iterator[Callable[[float], dict[str, Any]]]:
    """The bare renderer (`tests/load/bare.py`).

    Yields:
        A function that lets it render for so many seconds and returns {"seconds": [a frame], "cpu_s": in all}.
    """
    command = [sys.executable, "-m", "tests.load.bare", store, size]
    with _running(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:

        def render(seconds: float) -> dict[str, Any]:
            assert process.stdin is not None and process.stdout is not None
            process.stdin.write(f"{seconds}\n")
            process.stdin.flush()
            return json.loads(process.stdout.readline())

        yield render


@contextmanager
def baking() -> Iterator[None]:
    """A bake of the built-in tabletop in another process and store."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "service.cli", "run", "tabletop", "--store", folder, *BAKE]
        with _running(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            yield
            if process.poll() is not None:
                raise RuntimeError(f"the bake must last as long as the test, it ended with {process.returncode}")


@contextmanager
def _running(command: Sequence[str], **streams: int) -> Iterator["subprocess.Popen[str]"]:
    process = subprocess.Popen(command, text=True, **streams)  # type: ignore[call-overload]
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(30)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
