"""Ablations: the paper's choices against ours, on one scene, in one table.

Ground truth and camera paths are shared through the store; every variant bakes and trains what it needs.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from models.metrics import exposure_from_luminance, luminance, score_frame
from storage.caches import CacheSet
from storage.store import Store, UnitRef
from workers.bake import bake_refs, cache_nbytes, load_caches, run_bake
from workers.bake_lobes import lobes_of
from workers.element_stage import run_elements
from workers.elements import ElementSet
from workers.errors import WorkerError
from workers.evaluate import load_reference, mean_score
from workers.inputs import run_inputs
from workers.network_record import load_network
from workers.plan_stage import planned_run
from workers.progress import Progress
from workers.query import CHANNELS, QueryProgram
from workers.reconstruct import Reconstructor
from workers.render import load_render, run_render
from workers.run_state import RunState
from workers.scene import Scene
from workers.settings import Settings
from workers.train import run_train

PAPER: dict[str, Any] = {
    "cache.elements": "triangle", "cache.lobes": "exitant", "cache.azimuth": 64, "cache.polar": 16,
    "query.weights": "paper", "query.samples": 1, "train.transfer": "log1p", "train.residual": False,
    "train.unshuffle": 1, "train.widths": (32, 48, 64), "train.schedule": "paper",
    "train.perceptual_weight": 0.03, "train.learning_rate": 1e-3, "train.clip_quantile": 1.0,
    "train.negative_slope": 0.0,
}  # fmt: skip
_PAPER_CACHE = {key: value for key, value in PAPER.items() if not key.startswith("train.")}


@dataclass(frozen=True)
class Variant:
    """One row: its name, what it changes, and whether a network is trained for it."""

    name: str
    overrides: dict[str, Any]
    network: bool = True


def variants(settings: Settings) -> list[Variant]:
    """The rows, from the paper's configuration to ours; `settings` gives budgets."""
    half = max(1, settings.cache.directional_spp // 2)
    return [
        Variant("paper: triangle caches, 3 rays", PAPER),
        Variant("paper, 1 ray", _PAPER_CACHE | {"query.weights": "single"}, network=False),
        Variant("paper, vertex caches", _PAPER_CACHE | {"cache.elements": "vertex", "query.weights": "barycentric"},
                network=False),
        Variant("paper, lattice caches", _PAPER_CACHE | {"cache.elements": "lattice", "query.weights": "barycentric"},
                network=False),
        Variant("paper, 64x32 caches at equal bake time", _PAPER_CACHE | {"cache.polar": 32,
                "cache.directional_spp": half}, network=False),
        Variant("paper, our network", _PAPER_CACHE),
        Variant("uniform 64x16x32, our network", _PAPER_CACHE | {"cache.directional_spp": 32}),
        Variant("ours, no demodulation", {"cache.demodulate": False}),
        Variant("ours, blocks of 4x4 pixels", {"train.unshuffle": 4, "train.widths": (48, 64, 96)}),
        Variant("ours, concatenation", {"train.fusion": "concatenate"}),
        Variant("ours, with the perceptual term", {"train.perceptual_weight": 0.03}),
        Variant("ours, ReLU", {"train.negative_slope": 0.0}),
        Variant("ours, perceptual only", {"train.l1_weight": 0.0, "train.perceptual_weight": 1.0}),
        Variant("ours, 1x1 query", {"query.samples": 1}),
        Variant("ours, 2x2 query everywhere", {"query.supersample": "everywhere"}),
        Variant("ours, planned", {"plan.mode": "adaptive"}),
        Variant("ours, planned, a quarter of the elements",
                {"plan.mode": "adaptive", "cache.max_elements": max(1, settings.cache.max_elements // 4)}),
        Variant("ours", {}),
    ]  # fmt: skip


def chosen_variants(settings: Settings, names: Sequence[str] = ()) -> list[Variant]:
    """The rows that are named, in their own order; all of them where none is.

    Raises:
        WorkerError: a name is no row's.
    """
    rows = variants(settings)
    known = [row.name for row in rows]
    for name in names:
        if name not in known:
            raise WorkerError(f"ablation row must be one of {'; '.join(known)}, got {name!r}")
    return [row for row in rows if not names or row.name in names]


def run_ablation(
    scene: Scene, store: Store, settings: Settings, progress: Progress, names: Sequence[str] = ()
) -> list[dict[str, Any]]:
    """Runs the variants that are named, every one where none is.

    Returns:
        A row each: name, ir_psnr, psnr, ssim, flip (of the final frame; of IR where no network is trained),
        bake_paths, bake_seconds, cache_nbytes, and whole_paths and whole_nbytes (`bake_cost`).

    Raises:
        WorkerError: a name is no row's.
    """
    rows = []
    for variant in chosen_variants(settings, names):
        progress.message(f"ablation: {variant.name}")
        run = RunState(scene, store, settings.override(variant.overrides), progress)
        rows.append(_row(run, variant))
    return rows


def _row(run: RunState, variant: Variant) -> dict[str, Any]:
    run = planned_run(run)
    elements = run_elements(run)
    run_bake(run, elements)
    program = QueryProgram(run.scene.mi_scene, run.table, elements, load_caches(run, elements), run.settings.query)
    frames, paths = run.settings.frames, run.paths
    train_refs = run_render(run, paths.train, frames.train_spp, "render training frames")
    test_refs = run_render(run, paths.test, frames.test_spp, "render test references")
    features = [program.run(camera) for camera in paths.test]
    irs = [np.ascontiguousarray(f[..., slice(*CHANNELS["ir"])]) for f in features]
    exposure, finals = training_exposure(run, train_refs), irs
    if variant.network:
        validation_refs = run_render(run, paths.validation, frames.train_spp, "render validation frames")
        inputs = [run_inputs(run, elements, program, cameras) for cameras in (paths.train, paths.validation)]
        ref = run_train(run, (inputs[0], train_refs), (inputs[1], validation_refs))
        network, encoding = load_network(run, ref)
        reconstructor = Reconstructor(network, encoding, precision=run.settings.train.precision)
        finals = [reconstructor(f) for f in features]
    reference = load_reference(run, test_refs, exposure)
    ir_scores, scores = ([score_frame(x, y, exposure) for x, y in zip(images, reference.frames, strict=True)]
                         for images in (irs, finals))  # fmt: skip
    row = {"name": variant.name, "network": variant.network, "ir_psnr": mean_score(ir_scores, "psnr")}
    row |= {metric: mean_score(scores, metric) for metric in ("psnr", "ssim", "flip")}
    return row | bake_cost(run, elements)


def training_exposure(run: RunState, refs: list[UnitRef]) -> float:
    layer = "denoised" if run.settings.frames.denoise_train else "radiance"
    return exposure_from_luminance([luminance(load_render(run, ref)[layer]) for ref in refs])


def bake_cost(run: RunState, elements: ElementSet) -> dict[str, float]:
    """Paths, seconds and bytes of a run's bake.

    `whole_paths` and `whole_nbytes` are those of a bake that does not ask what is seen: every (tessellated) triangle's
    front, for caches a triangle; what was baked, for the others.
    """
    cache, seconds = run.settings.cache, 0.0
    for ref in bake_refs(run, elements).values():
        caches = CacheSet.open(run.store, ref)
        records = [caches.unit_record(index) for index in range(caches.num_units)]
        seconds += sum(float(record["seconds"]) for record in records if record)
    paths = cache.passes * sum(len(lobe.owners) * lobe.lanes_per_element for lobe in lobes_of(run, elements))
    nbytes = cache_nbytes(run, elements)
    unseen = elements.patches.num_patches / elements.num_elements if cache.elements == "triangle" else 1.0
    return {"bake_paths": paths, "bake_seconds": seconds, "cache_nbytes": nbytes, "whole_paths": paths * unseen,
            "whole_nbytes": nbytes * unseen}  # fmt: skip
