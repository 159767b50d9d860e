"""Evaluation: our frames against path tracing with and without Open Image Denoise, timed interleaved in one run."""

import platform
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch

from models.metrics import Perceptual, Scores, flip, reference_error_db, score_frame, temporal_difference, tone_map
from models.perceptual import StLpips
from models.reprojection import reproject
from storage.perceptual_weights import find_stlpips
from storage.store import UnitRef
from workers.camera import Camera
from workers.denoise import denoise
from workers.pathtrace import trace
from workers.query import CHANNELS
from workers.render import load_render
from workers.renderer import FrameRenderer
from workers.run_state import RunState
from workers.timing import interleaved_medians

REFERENCE_MARGIN_DB = 3.0
PICTURE_METHODS = ("ir", "ours", "pt-1+oidn-high", "pt-4+oidn-high")
MAX_PICTURES = 3


@dataclass(frozen=True)
class Picture:
    """Images of one test frame for the report.

    Attributes:
        title: which frame.
        images: label to linear radiance, float32 [height, width, 3]; "reference" among them.
        flip_maps: label to FLIP error in [0, 1], float32 [height, width].
        exposure: of the scene.
    """

    title: str
    images: dict[str, np.ndarray]
    flip_maps: dict[str, np.ndarray]
    exposure: float


@dataclass(frozen=True)
class Evaluation:
    """Result (plain JSON values) and pictures."""

    result: dict[str, Any]
    pictures: list[Picture]


@dataclass(frozen=True)
class Reference:
    """Test references and how good they are."""

    frames: list[np.ndarray]
    error_db: float
    denoised: bool


def run_evaluation(
    run: RunState, renderer: FrameRenderer, test_refs: list[UnitRef], stages: dict[str, float], sizes: dict[str, int]
) -> Evaluation:
    """Scores and times every method on the test path."""
    exposure = renderer.reconstructor.encoding.exposure
    reference = load_reference(run, test_refs, exposure)
    perceptual = find_perceptual()
    methods = compared_methods(run, renderer)
    cameras = run.paths.test
    with run.progress.track("evaluate", len(methods) * len(cameras)) as advance:
        frames: dict[str, list[np.ndarray]] = {}
        for name, method in methods.items():
            frames[name] = []
            for index, camera in enumerate(cameras):
                frames[name].append(method(camera, index))
                advance(note=name)
    timed: dict[str, Callable[[int], object]] = {
        name: lambda index, method=method: method(cameras[index % len(cameras)], index)  # type: ignore[misc]
        for name, method in methods.items()
    }
    medians = interleaved_medians(timed, run.settings.evaluation.timing_repeats, run.progress, "time")
    positions = [positions_of(renderer, camera) for camera in cameras]
    near_cameras = [run.scene.frame.near_camera(camera) for camera in cameras]
    rows = []
    with run.progress.track("score", len(methods)) as advance:
        for name in methods:
            shared = (reference.frames, exposure, perceptual, near_cameras, positions)
            rows.append(score_row(name, frames[name], *shared, 1e3 * medians[name]))
            advance(note=name)
    coverage = float(np.mean([renderer.render(camera).coverage for camera in cameras]))
    notes = [*run.scene.notes, *run.paths.notes]
    if reference.denoised:
        notes.append(
            f"the raw test references would cap every score at {reference.error_db:.1f} dB: they were denoised "
            "(Open Image Denoise, high); methods that use it are favoured by that"
        )
    result = {
        "scene": run.scene.name, "width": run.settings.width, "height": run.settings.height, "rows": rows,
        "stages": [{"name": name, "seconds": seconds} for name, seconds in stages.items()],
        "cache_nbytes": sizes["cache"], "network_nbytes": sizes["network"],
        "reference_error_db": reference.error_db, "reference_denoised": reference.denoised,
        "exposure": exposure, "coverage": coverage, "preset": run.settings.preset, "machine": machine(),
        "commit": commit(), "network_choice": renderer.reconstructor.choices, "settings": run.settings.to_json(),
        "notes": notes,
    }  # fmt: skip
    return Evaluation(result, _pictures(frames, reference.frames, exposure))


def load_reference(run: RunState, refs: list[UnitRef], exposure: float) -> Reference:
    """Raw references, or denoised ones where their own noise would cap the scores (`frames.denoise_test`)."""
    layers = [load_render(run, ref) for ref in refs]
    errors = [reference_error_db(x["radiance"], x["standard_error"], exposure) for x in layers]
    error_db = float(np.mean(errors))
    choice, floor = run.settings.frames.denoise_test, run.settings.frames.reference_floor_db
    denoised = choice == "always" or (choice == "capped" and error_db < floor)
    return Reference([x["denoised" if denoised else "radiance"] for x in layers], error_db, denoised)


def find_perceptual() -> Perceptual | None:
    weights = find_stlpips()
    if weights is None:
        return None
    return StLpips(weights["vgg"] if "vgg" in weights else weights["alex"])


Method = Callable[[Camera, int], np.ndarray]


def compared_methods(run: RunState, renderer: FrameRenderer) -> dict[str, Method]:
    """Every row of the table: a function from camera and frame index to radiance, all of it timed."""
    a, b = CHANNELS["ir"]

    def ir(camera: Camera, index: int) -> np.ndarray:
        del index
        return np.ascontiguousarray(renderer.program.run(camera)[..., a:b])

    def ir_denoised(camera: Camera, index: int) -> np.ndarray:
        del index
        features = renderer.program.run(camera)
        parts = [features[..., slice(*CHANNELS[name])] for name in ("ir", "albedo", "normal")]
        return denoise(*parts, quality="high", clean_features=True)

    def ours(camera: Camera, index: int) -> np.ndarray:
        del index
        frame = renderer.render(camera)
        return renderer.unchecked(camera) if frame.non_finite else frame.radiance

    methods: dict[str, Method] = {
        "ours": ours,
        "ir": ir,
        "ir+oidn": ir_denoised,
    }
    for spp in run.settings.evaluation.spp:
        methods[f"pt-{spp}"] = _traced(run, spp, None)
        for quality in run.settings.evaluation.qualities:
            methods[f"pt-{spp}+oidn-{quality}"] = _traced(run, spp, quality)
    return methods


def _traced(run: RunState, spp: int, quality: str | None) -> Method:
    seed = run.seed(run.ref("adversary", {"spp": spp}))

    def method(camera: Camera, index: int) -> np.ndarray:
        image = trace(run.scene, camera, spp, (seed + index) % 2**32, features=quality is not None)
        if quality is None:
            return image.radiance
        return denoise(image.radiance, image.albedo, image.normal, quality=quality)

    return method


def positions_of(renderer: FrameRenderer, camera: Camera) -> np.ndarray:
    a, b = CHANNELS["position"]
    return np.ascontiguousarray(renderer.program.run(camera)[..., a:b])


def score_row(
    name: str, frames: list[np.ndarray], references: list[np.ndarray], exposure: float,
    perceptual: Perceptual | None, cameras: list[Camera], positions: list[np.ndarray], milliseconds: float,
) -> dict[str, Any]:  # fmt: skip
    scores = [score_frame(x, y, exposure, perceptual) for x, y in zip(frames, references, strict=True)]
    non_finite = sum(score.non_finite for score in scores)
    row: dict[str, Any] = {"name": name}
    for metric in ("psnr", "ssim", "flip", "st_lpips", "relmse"):
        row[metric] = mean_score(scores, metric)
    row["temporal"] = None if non_finite else _temporal(frames, references, exposure, cameras, positions)
    return row | {"ms": milliseconds, "non_finite": non_finite}


def mean_score(scores: list[Scores], metric: str) -> float | None:
    """Mean of a metric over frames, or None where any frame was refused it."""
    values = [getattr(score, metric) for score in scores]
    return None if any(value is None for value in values) else float(np.mean(values))


def _temporal(
    frames: list[np.ndarray], references: list[np.ndarray], exposure: float, cameras: list[Camera],
    positions: list[np.ndarray],
) -> float | None:  # fmt: skip
    """Warped difference between consecutive test frames, ours against the reference's own."""
    differences = []
    for i in range(1, len(frames)):
        camera = cameras[i - 1]
        pairs = [tone_map(image, exposure) for image in (frames[i], frames[i - 1], references[i], references[i - 1])]
        both = np.concatenate([pairs[1], pairs[3]], axis=2)
        warped, valid = reproject(both, positions[i], positions[i - 1], camera.to_world, camera.fov_deg)
        value = temporal_difference(pairs[0], warped[..., :3], pairs[2], warped[..., 3:], valid)
        if value is not None:
            differences.append(value)
    return float(np.mean(differences)) if differences else None


def _pictures(frames: dict[str, list[np.ndarray]], references: list[np.ndarray], exposure: float) -> list[Picture]:
    pictures = []
    for index in range(min(len(references), MAX_PICTURES)):
        images = {name: frames[name][index] for name in PICTURE_METHODS if name in frames}
        target = tone_map(references[index], exposure)
        maps = {
            name: flip(tone_map(image, exposure), target)[1]
            for name, image in images.items()
            if np.isfinite(image).all()
        }
        pictures.append(Picture(f"test frame {index}", images | {"reference": references[index]}, maps, exposure))
    return pictures


def machine() -> str:
    """The machine's size, for tables."""
    gib = psutil.virtual_memory().total / 2**30
    device = f", {torch.cuda.get_device_name(0)}" if torch.cuda.is_available() else ""
    return f"{psutil.cpu_count()} CPU threads ({platform.machine()}), {gib:.0f} GiB memory{device}"


def commit() -> str:
    """Commit of the code that ran, or "unknown" outside a checkout."""
    try:
        command = ["git", "describe", "--always", "--dirty", "--abbrev=12"]
        folder = Path(__file__).resolve().parent
        return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
