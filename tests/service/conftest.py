"""Stand-ins for what workers hand to the service: an evaluation, and scenes that answer at once."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

SCORES = {"psnr": 30.0, "ssim": 0.9, "flip": 0.1, "st_lpips": 0.2, "relmse": 0.05, "temporal": 0.01}


@dataclass(frozen=True)
class FakePicture:
    title: str
    images: dict[str, np.ndarray]
    flip_maps: dict[str, np.ndarray]
    exposure: float


@dataclass(frozen=True)
class FakeEvaluation:
    result: dict[str, Any]
    pictures: list[FakePicture]


@dataclass(frozen=True)
class FakeFrame:
    radiance: np.ndarray
    seconds: dict[str, float]
    coverage: float = 0.97531
    exposure: float = 1.0
    non_finite: int = 0


def score_row(name: str, **values: Any) -> dict[str, Any]:
    return {"name": name, **SCORES, "ms": 10.0, "non_finite": 0, **values}


def make_evaluation(scene: str = "tabletop", width: int = 24, height: int = 16) -> FakeEvaluation:
    rows = [
        score_row("ours", psnr=34.25, flip=0.04, ms=8.0),
        score_row("ir", psnr=28.0, ms=3.0),
        score_row("pt-1", psnr=12.0, ms=20.0),
        score_row("pt-1+oidn-high", psnr=31.0, st_lpips=None, ms=140.0),
        score_row("pt-4+oidn-high", psnr=99.0, non_finite=3, ms=400.0),
    ]
    result = {
        "scene": scene,
        "width": width,
        "height": height,
        "rows": rows,
        "stages": [{"name": "bake", "seconds": 90.0}, {"name": "train", "seconds": 30.0}],
        "cache_nbytes": 3 * 2**20,
        "network_nbytes": 1536,
        "reference_error_db": 33.0,
        "exposure": 0.75,
        "coverage": 0.991,
        "machine": {"cpu": "two cores"},
        "commit": "0123456",
        "settings": {"cache": {"diffuse_spp": 256}},
        "notes": ["the reference was denoised"],
    }
    ramp = np.linspace(0, 1, width * height * 3, dtype=np.float32).reshape(height, width, 3)
    labels = ("reference", "pt-1+oidn-high", "ours", "ir")
    images = {label: ramp * (k + 1) for k, label in enumerate(labels)}
    flips = {label: ramp[..., 0] for label in labels if label != "reference"}
    return FakeEvaluation(result, [FakePicture("frame 3", images, flips, 0.75)])


@dataclass
class FakeBackend:
    """Two scenes that share a name and one of its own; notes which thread opened and rendered."""

    seconds_a_frame: float = 0.0
    opened: list[str] = field(default_factory=list)
    cameras: list[Any] = field(default_factory=list)
    threads: set[int] = field(default_factory=set)
    busy: int = 0
    most_busy: int = 0
    failure: BaseException | None = None
    non_finite: int = 0
    nbytes: int = 1000
    num_trims: int = 0
    gate: threading.Event | None = None  # a frame waits for it
    begun: threading.Event = field(default_factory=threading.Event)  # set by a frame that does

    def scenes(self) -> list[dict[str, Any]]:
        facts = {"network": "n1", "width": 64, "height": 64, "preset": "draft", "psnr": None}
        names = {"d1": "tabletop", "d2": "hall", "d3": "hall"}
        return [{"name": name, "digest": digest, **facts} for digest, name in names.items()]

    def warm_up(self) -> None:
        self.threads.add(threading.get_ident())

    def trim(self) -> None:
        self.num_trims += 1

    def open(self, digest: str) -> "FakeBackend":
        self.threads.add(threading.get_ident())
        self.opened.append(digest)
        return self

    def render(self, camera: Any) -> FakeFrame:
        self.threads.add(threading.get_ident())
        if self.failure is not None:
            raise self.failure
        self.busy += 1
        self.most_busy = max(self.busy, self.most_busy)
        self.begun.set()
        if self.gate is not None:
            assert self.gate.wait(10)
        time.sleep(self.seconds_a_frame)
        self.cameras.append(camera)
        radiance = np.full((camera.height, camera.width, 3), 0.25, np.float32)
        self.busy -= 1
        return FakeFrame(radiance, {"query": 0.004, "network": 0.0015}, non_finite=self.non_finite)


@pytest.fixture
def evaluation() -> FakeEvaluation:
    return make_evaluation()


@pytest.fixture
def backend() -> FakeBackend:
    return FakeBackend()


@pytest.fixture
def until() -> Callable[[Callable[[], bool]], None]:
    """Waits until something is true; fails after ten seconds."""

    def wait(true: Callable[[], bool]) -> None:
        deadline_s = time.monotonic() + 10
        while not true():
            assert time.monotonic() < deadline_s, "it did not come true within 10 s"
            time.sleep(0.005)

    return wait
