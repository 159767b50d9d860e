"""Path-traced images: ground truth and the adversary, from one function."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from workers.backend import dr, mi
from workers.camera import Camera
from workers.scene import Scene

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
def _integrator(max_depth: int, features: bool) -> "mi.Integrator":
    path = {"type": "path", "max_depth": max_depth}
    if not features:
        return mi.load_dict(path)
    return mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal", "path": path})


def trace(scene: Scene, camera: Camera, spp: int, seed: int, *, features: bool = False) -> TracedImage:
    """Path-traces one image with `scene.max_depth`; box filter, so the same seed gives the same bits.

    Args:
        scene: the scene.
        camera: pose and size.
        spp: paths per pixel.
        seed: uint32; launches of a large image take the seeds that follow.
        features: also return albedo and normal, averaged over the same samples.
    """
    pixels = camera.width * camera.height
    per_launch = max(1, min(spp, SAMPLES_PER_LAUNCH // pixels))
    sensor = scene.make_sensor(camera)
    integrator = _integrator(scene.max_depth, features)
    total, done = None, 0
    while done < spp:
        count = min(per_launch, spp - done)
        launch_seed = (seed + done) % 2**32
        image = mi.render(scene.mi_scene, sensor=sensor, integrator=integrator, spp=count, seed=launch_seed)
        value = np.array(image, dtype=np.float32)
        total = value * count if total is None else total + value * count
        done += count
    assert total is not None
    mean = total / spp
    if not features:
        return TracedImage(np.ascontiguousarray(mean[..., :3], dtype=np.float32))
    radiance, albedo, normal = (np.ascontiguousarray(mean[..., i : i + 3], dtype=np.float32) for i in (0, 3, 6))
    return TracedImage(radiance, np.clip(albedo, 0, 1), normal)


def flush() -> None:
    """Waits until the device is idle (for timing)."""
    dr.sync_thread()
