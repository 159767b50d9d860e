"""Variants of a sweep made ready: baked, trained and opened; whatever the store has is not computed again."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from storage.store import UnitRef
from workers.ablation import bake_cost
from workers.camera import Camera
from workers.element_stage import run_elements
from workers.point_parts import PointParts, Reconstruct, derived_run
from workers.query import QueryProgram
from workers.reconstruct import Reconstructor
from workers.renderer import make_frame
from workers.run_state import RunState
from workers.tradeoff_variants import (
    SweepVariant,
    TradeoffBudget,
    affordable,
    bake_variant,
    sweep_variants,
    train_variant,
    trained,
)
from workers.train import WEIGHTS_FILE, load_network


@dataclass
class PreparedVariant:
    """A variant with its caches baked and its network trained."""

    variant: SweepVariant
    network: str | None
    precision: str
    program: QueryProgram
    reconstruct: Reconstruct
    costs: dict[str, Any]
    exposure: float

    def render(self, camera: Camera, index: int = 0) -> np.ndarray:
        del index
        frame = make_frame(self.program, self.reconstruct, self.exposure, camera)
        # What was mended for the frame is not mended for its score.
        return self.reconstruct(self.program.run(camera)) if frame.non_finite else frame.radiance


def base_run(run: RunState, budget: TradeoffBudget) -> RunState:
    """The run as it was trained, or with training that the budget affords."""
    return run if trained(run) is not None else derived_run(run, affordable(run.settings, budget))


def prepare_variants(base: RunState, budget: TradeoffBudget) -> list[PreparedVariant]:
    parts, prepared = PointParts(base), list[PreparedVariant]()
    variants = sweep_variants(base.settings, budget)
    with base.progress.track("sweep", len(variants)) as advance:
        for variant in variants:
            made = _prepare(base, parts, variant, prepared[0] if prepared else None, budget)
            if made is not None:
                prepared.append(made)
            advance(note=variant.name)
    return prepared


def _prepare(
    base: RunState, parts: PointParts, variant: SweepVariant, first: PreparedVariant | None, budget: TradeoffBudget
) -> PreparedVariant | None:
    """None where the variant cannot be had: bf16 that strays from fp32."""
    settings = base.settings.override(variant.overrides)
    run = derived_run(base, settings)
    bake_variant(run)
    program = parts.program(variant.overrides)
    network = first.network if first and variant.network == "base" else None
    if variant.network == "own":
        if first is not None:
            run = derived_run(base, affordable(settings, budget))
        network = train_variant(run, program).key
    precision, exposure = "fp32", first.exposure if first else 1.0
    if network is not None:
        precision = _resolved(base, program, network, variant)
        if variant.precision == "bf16" and precision != "bf16":
            base.progress.message("bf16 strays from fp32 on this network: no operating point uses it")
            return None
    reconstruct = parts.reconstruct(network, precision, variant.scale)
    if first is None and network is not None:
        exposure = load_network(base, network_ref(base, network))[1].exposure
    return PreparedVariant(variant, network, precision, program, reconstruct, _costs(run, network), exposure)


def network_ref(run: RunState, key: str) -> UnitRef:
    return UnitRef(run.scene.digest, "train", key)


def _resolved(base: RunState, program: QueryProgram, network: str, variant: SweepVariant) -> str:
    """The precision that is measured fastest at the run's size, where the variant leaves it open."""
    if variant.precision == "fp32":
        return "fp32"
    loaded, encoding = load_network(base, network_ref(base, network))
    chooser = Reconstructor(loaded, encoding, precision=variant.precision)
    camera = base.paths.test[0]
    chooser(program.run(camera))
    return chooser.choices[f"{camera.width}x{camera.height}"]


def _costs(run: RunState, network: str | None) -> dict[str, Any]:
    """Bake seconds and paths, bytes at rest, and seconds of training, from the store's records."""
    baked = bake_cost(run, run_elements(run))
    nbytes, train_seconds = int(baked["cache_nbytes"]), None
    if network is not None:
        ref = network_ref(run, network)
        nbytes += len(run.store.read(ref, WEIGHTS_FILE))
        train_seconds = float((run.store.committed(ref) or {}).get("seconds", 0.0))
    return {"bake_seconds": baked["bake_seconds"], "bake_paths": baked["bake_paths"], "nbytes": nbytes,
            "train_seconds": train_seconds}  # fmt: skip
