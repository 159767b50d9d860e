"""Path-traced images: ground truth and the adversary, from one function."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from workers.backend import dr, mi
from workers.camera import Camera
from workers.scene import Scene

FEATURE_SPP = 16
SAMPLES_PER_LAUNCH = 1 << 24  # wavefront of one launch: a few GiB of state at most; more samples loop over seeds


@dataclass(frozen=True)
class TracedImage:
    """A path-traced image with the auxiliary features of the same samples.

    Attributes:
        radiance: float32 [height, width, 3], linear scene radiance.
        albedo: float32 [height, width, 3] in [0, 1], or None when not asked for.
        normal: float32 [height, width, 3], world space, or None when not asked for.
    """

    radiance: np.ndarray
    albedo: np.ndarray | None = None
    normal: np.ndarray | None = None


@lru_cache(maxsize=16)
def _path(max_depth: int) -> "mi.Integrator":
    return mi.load_dict({"type": "path", "max_depth": max_depth})


@lru_cache(maxsize=1)
def _features() -> "mi.Integrator":
    return mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})


def _go_on() -> None:
    """Between two launches of somebody who cannot be stopped."""


def trace(
    scene: Scene, camera: Camera, spp: int, seed: int, *, features: bool = False,
    between_launches: Callable[[], None] = _go_on,
) -> TracedImage:  # fmt: skip
    """Path-traces one image with `scene.max_depth`; box filter, so the same seed gives the same bits.

    Features are rendered apart: with the path integrator nested in `aov` the paths are traced twice (measured: 2.1
    times the time of the path integrator alone, against 1.1 for both one after the other).

    Args:
        scene: the scene.
        camera: pose and size.
        spp: paths per pixel.
        seed: uint32; launches of a large image take the seeds that follow.
        features: also return albedo and normal, at most `FEATURE_SPP` samples a pixel.
        between_launches: called after each launch; what it raises ends the image.
    """
    sensor = scene.make_sensor(camera)
    radiance = _render(scene, sensor, camera, _path(scene.max_depth), spp, seed, between_launches)
    if not features:
        return TracedImage(radiance)
    layers = _render(scene, sensor, camera, _features(), min(spp, FEATURE_SPP), seed, between_launches)
    albedo, normal = (np.ascontiguousarray(layers[..., i : i + 3]) for i in (0, 3))
    return TracedImage(radiance, np.clip(albedo, 0, 1), normal)


def _render(
    scene: Scene, sensor: "mi.Sensor", camera: Camera, integrator: "mi.Integrator", spp: int, seed: int,
    between_launches: Callable[[], None],
) -> np.ndarray:  # fmt: skip
    """Mean over launches that fit `SAMPLES_PER_LAUNCH`, float32 [height, width, channels]."""
    per_launch = max(1, min(spp, SAMPLES_PER_LAUNCH // (camera.width * camera.height)))
    total = np.zeros(1, np.float64)
    done = 0
    while done < spp:
        count = min(per_launch, spp - done)
        launch_seed = (seed + done) % 2**32
        image = mi.render(scene.mi_scene, sensor=sensor, integrator=integrator, spp=count, seed=launch_seed)
        total = total + np.array(image, dtype=np.float64) * count
        done += count
        between_launches()
    return (total / spp).astype(np.float32)


def flush() -> None:
    """Waits until the device is idle (for timing)."""
    dr.sync_thread()
