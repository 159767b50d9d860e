"""One dataset out of a batch: its frames from the store, with what each is and where it comes from.

A frame enters as rendered: no clipping, no denoising. One that holds NaN or infinity is left out and named.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from models.metrics import exposure_from_luminance, luminance
from storage import dataset_layout as layout
from storage.datasets import DatasetWriter
from storage.frames import HALF_MAX, health
from workers.batch_frames import PATH_OF_PART, FrameUnit, frame_units
from workers.batch_matrix import BatchError, BatchItem
from workers.errors import WorkerError
from workers.render import load_render
from workers.run_state import RunState
from workers.splits import SplitBy, split_of_part, split_of_scenes

_LAYER_OF_FEATURE = {"hdr": "radiance", "alb": "albedo", "nrm": "normal", "err": "standard_error"}
_INPUT_FEATURES = ("hdr", "alb", "nrm")
FEATURES = {
    "hdr": "linear scene radiance, Rec. 709 primaries, float32",
    "alb": "albedo of the first hit, 0 to 1, half",
    "nrm": "shading normal of the first hit in world space, -1 to 1, half",
    "err": "standard error of hdr, estimated from independent passes, float32",
}


@dataclass(frozen=True)
class _Variant:
    """One combination with what all of its frames share."""

    item: BatchItem
    run: RunState
    exposure: float
    scene_split: str | None


def write_dataset(runs: Iterable[tuple[BatchItem, RunState]], folder: str, *, split_by: SplitBy,
                  bases: list[str]) -> dict[str, Any]:  # fmt: skip
    """Writes the dataset of a batch.

    Args:
        runs: the batch's combinations; their frames are in the store.
        folder: a folder or fsspec URL; empty, or a dataset that is brought up to date.
        split_by: "path" or "scene".
        bases: scenes of the whole batch, for the split by scene.

    Returns:
        The manifest.

    Raises:
        WorkerError: a frame is missing, or nothing could be used.
        StorageError: the folder holds something else, or a frame is damaged.
    """
    of_scene = split_of_scenes(bases) if split_by == "scene" or len(set(bases)) >= 3 else {}
    writer = DatasetWriter(folder)
    scenes: list[dict[str, Any]] = []
    frames: list[dict[str, Any]] = []
    excluded: list[dict[str, Any]] = []
    seen: set[tuple[str, str]] = set()
    for item, run in runs:
        units = frame_units(run, item.input_spp)
        _check_rendered(run, units)
        variant = _Variant(item, run, _exposure(run, units), of_scene.get(item.base))
        scenes.append(_scene_entry(variant))
        for _, pose in groupby(units, key=lambda unit: (unit.part, unit.index)):
            pose_units = list(pose)
            known = (run.scene.digest, pose_units[-1].ref.key)
            if known not in seen:  # two presets may ask for the same frame
                seen.add(known)
                frame = _add_pose(writer, variant, pose_units, split_by, excluded)
                frames += [frame] if frame else []
    if not frames:
        raise WorkerError(f"dataset must hold at least one frame, got none and {len(excluded)} left out")
    counts = {split: sum(frame["split"] == split for frame in frames) for split in layout.SPLITS}
    return writer.finish({"split_by": split_by, "splits": counts, "features": FEATURES, "scenes": scenes,
                          "frames": frames, "excluded": excluded})  # fmt: skip


def _check_rendered(run: RunState, units: list[FrameUnit]) -> None:
    missing = sum(run.store.committed(unit.ref) is None for unit in units)
    if missing:
        raise BatchError(
            f"frames of {run.scene.name!r} must be rendered before a dataset is made of them, "
            f"got {missing} of {len(units)} missing; run: lightwell batch run"
        )


def _exposure(run: RunState, units: list[FrameUnit]) -> float:
    """The scene's exposure over its training references, as training has it."""
    references = [unit for unit in units if unit.part == "train" and unit.role == "reference"]
    frames = (load_render(run, unit.ref)["radiance"] for unit in references)
    return float(exposure_from_luminance([luminance(np.where(np.isfinite(frame), frame, 0.0)) for frame in frames]))


def _scene_entry(variant: _Variant) -> dict[str, Any]:
    scene, item = variant.run.scene, variant.item
    return {
        "digest": scene.digest, "name": scene.name, "source": item.base, "preset": item.preset, "label": item.label,
        "variation": dict(scene.variation), "exposure": variant.exposure, "max_depth": scene.max_depth,
        "width": variant.run.settings.width, "height": variant.run.settings.height, "notes": list(scene.notes),
    }  # fmt: skip


def _add_pose(writer: DatasetWriter, variant: _Variant, units: list[FrameUnit], split_by: SplitBy,
              excluded: list[dict[str, Any]]) -> dict[str, Any] | None:  # fmt: skip
    """Writes a pose's images; None where its reference, or every input it should have, is not usable."""
    run, reference = variant.run, units[-1]
    splits = {"path": split_of_part(reference.part), "scene": variant.scene_split}
    split = splits[split_by] or ""
    digest = run.scene.digest
    group = layout.group_name(
        run.scene.name[:64], digest[:8], variant.item.preset, reference.part, f"{reference.index:04d}"
    )
    images, inputs_left_out = [], 0
    for unit in reversed(units):
        layers = load_render(run, unit.ref)
        problem = _problem(layers, unit)
        if problem:
            excluded.append({"group": group, "role": unit.role, "spp": unit.spp, "unit_key": unit.ref.key,
                             "scene": digest, "reason": problem})  # fmt: skip
            if unit is reference:
                return None
            inputs_left_out += 1
            continue
        images.append(_add_image(writer, run, unit, layers, split, group))
    if inputs_left_out and len(images) == 1:
        return None
    writer.add_exposure(split, group, variant.exposure)
    return {
        "group": group, "scene": digest, "split": split, "splits": splits, "path": PATH_OF_PART[reference.part],
        "part": reference.part, "index": reference.index, "camera": reference.camera.to_json(),
        "exposure": variant.exposure, "variation": variant.item.variation and variant.item.variation.to_json(),
        "images": images[::-1],
    }  # fmt: skip


def _problem(layers: dict[str, np.ndarray], unit: FrameUnit) -> str:
    """Why an image cannot be used; empty where it can."""
    features = _features_of(unit)
    counts = health({feature: layers[_LAYER_OF_FEATURE[feature]] for feature in features})
    bad = [f"{entry['nan']} NaN and {entry['inf']} infinite values in {feature}"
           for feature, entry in counts.items() if entry["nan"] or entry["inf"]]  # fmt: skip
    return "; ".join(bad)


def _features_of(unit: FrameUnit) -> tuple[str, ...]:
    return _INPUT_FEATURES if unit.role == "input" else (*_INPUT_FEATURES, "err")


def _add_image(writer: DatasetWriter, run: RunState, unit: FrameUnit, layers: dict[str, np.ndarray], split: str,
               group: str) -> dict[str, Any]:  # fmt: skip
    record = run.store.committed(unit.ref) or {}
    spp = int(record["spp"])
    name = layout.image_name(group, spp if unit.role == "input" else None)
    features = {feature: layers[_LAYER_OF_FEATURE[feature]] for feature in _features_of(unit)}
    for feature in ("alb", "nrm"):
        features[feature] = np.clip(features[feature], -HALF_MAX, HALF_MAX)
    return {
        "name": name, "role": unit.role, "spp": spp, "unit_key": unit.ref.key, "seed": record["seed"],
        "standard_error": _noise(run, unit, layers), "health": record["health"],
        "non_finite_samples": record["non_finite_samples"], "render_seconds": record["seconds"],
        "versions": record.get("versions"), "files": writer.add_image(split, name, features),
    }  # fmt: skip


def _noise(run: RunState, unit: FrameUnit, layers: dict[str, np.ndarray]) -> dict[str, float] | None:
    """Mean standard error, as radiance and relative to the frame's mean; None where one pass cannot tell it."""
    if min(run.settings.frames.passes, unit.spp) < 2:
        return None
    mean_error = float(layers["standard_error"].mean(dtype=np.float64))
    mean = float(layers["radiance"].mean(dtype=np.float64))
    return {"mean": mean_error, "relative": mean_error / mean if mean > 0 else 0.0}
