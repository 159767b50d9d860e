"""Stage `render`: ground truth of one pose, N spp in seeded passes, with its standard error."""

import time

import numpy as np

from storage.frames import decode_frame, encode_frame, health
from storage.store import UnitRef
from workers.camera import Camera
from workers.denoise import denoise
from workers.errors import QuarantinedError
from workers.pathtrace import trace
from workers.run_state import RunState, camera_params

STAGE = "render"
FILE = "frame.exr"
MAX_NON_FINITE_SHARE = 1e-3


def render_ref(run: RunState, camera: Camera, spp: int) -> UnitRef:
    """The unit that holds a pose's ground truth."""
    params = {"camera": camera_params(camera), "spp": spp, "passes": run.settings.frames.passes,
              "max_depth": run.scene.max_depth}  # fmt: skip
    return run.ref(STAGE, params)


def run_render(run: RunState, cameras: list[Camera], spp: int, description: str) -> list[UnitRef]:
    """Renders whatever poses the store lacks."""
    start = time.perf_counter()
    refs = [render_ref(run, camera, spp) for camera in cameras]
    missing = [pair for pair in zip(refs, cameras, strict=True) if run.store.committed(pair[0]) is None]
    if not missing:
        return refs
    with run.progress.track(description, len(cameras)) as advance:
        advance(len(cameras) - len(missing))
        for ref, camera in missing:
            _render_frame(run, ref, camera, spp)
            advance()
    run.seconds[description] = time.perf_counter() - start
    return refs


def _render_frame(run: RunState, ref: UnitRef, camera: Camera, spp: int) -> None:
    start = time.perf_counter()
    passes = min(run.settings.frames.passes, spp)
    per_pass = -(-spp // passes)
    seed = run.seed(ref)
    total = np.zeros((camera.height, camera.width, 3), np.float64)
    square = total.copy()
    albedo = normal = np.zeros_like(total, np.float32)
    non_finite = 0
    for index in range(passes):
        pass_seed = (seed + index * 1_000_003) % 2**32
        image = trace(run.scene, camera, per_pass, pass_seed, features=index == 0,
                      between_launches=run.progress.between_passes)  # fmt: skip
        finite = np.isfinite(image.radiance).all(axis=2, keepdims=True)
        non_finite += int(finite.size - finite.sum())
        radiance = np.where(finite, image.radiance, 0.0).astype(np.float64)
        total += radiance
        square += radiance**2
        if image.albedo is not None and image.normal is not None:
            albedo, normal = image.albedo, image.normal
    size = camera.width * camera.height * passes
    if non_finite > MAX_NON_FINITE_SHARE * size:
        facts = {"non_finite": non_finite, "pixels": size, "max_share": MAX_NON_FINITE_SHARE}
        reason = (f"ground truth {ref} must be finite, got {non_finite} of {size} pixels NaN or Inf; "
                  "look for NaN in the scene's textures")  # fmt: skip
        run.store.quarantine(ref, reason, facts=facts)
        raise QuarantinedError(reason, facts)
    mean = total / passes
    variance = np.maximum(square / passes - mean**2, 0.0) / max(passes - 1, 1)
    layers = {"radiance": mean, "standard_error": np.sqrt(variance), "albedo": albedo,
              "normal": normal}  # fmt: skip
    layers = {name: np.ascontiguousarray(value, np.float32) for name, value in layers.items()}
    layers["denoised"] = denoise(layers["radiance"], layers["albedo"], layers["normal"], quality="high")
    record = {"seconds": time.perf_counter() - start, "spp": per_pass * passes, "camera": camera_params(camera),
              "health": health(layers), "non_finite_samples": non_finite}  # fmt: skip
    run.store.commit(ref, {FILE: encode_frame(layers)}, record)


def load_render(run: RunState, ref: UnitRef) -> dict[str, np.ndarray]:
    """Layers of a rendered pose: radiance, standard_error, albedo, normal, denoised."""
    return decode_frame(run.store.read(ref, FILE))
