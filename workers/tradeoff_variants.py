"""What the trade is swept over: caches, query, network, precision and output scale, one change at a time."""

from dataclasses import dataclass
from typing import Any, Literal

from storage.store import Store, UnitRef
from workers.ablation import PAPER
from workers.bake import run_bake
from workers.element_stage import run_elements
from workers.errors import WorkerError
from workers.inputs import inputs_ref, run_inputs
from workers.render import render_ref, run_render
from workers.run_state import RunState
from workers.settings import Settings
from workers.train import run_train, train_ref

OURS = "ours"
# The paper's own, whatever the preset spends; only the seconds of training are the sweep's.
_PAPER_BUDGET = {"cache.directional_spp": 32, "train.batch": 2, "train.perceptual_every": 1}
CHEAPER = 4  # of elements, samples or directions: the factor that a bake variant saves


@dataclass(frozen=True, kw_only=True)
class TradeoffBudget:
    """What a sweep may cost; small, because it trains about ten networks.

    Attributes:
        network_seconds: training of each network, at most; the run's own network is taken as it is where the
            store has it.
        sizes: (width, height) at which our points are timed besides the run's own size, pixels; the smallest and the
            largest bound what `max_ms` can be promised for.
        repeats: timed rounds; medians count, and what single rounds stray from them is the points' spread.
        spp: path-traced rows.
        paper: also bake and train the paper-exact configuration.
    """

    network_seconds: float = 60.0
    sizes: tuple[tuple[int, int], ...] = ((128, 72), (320, 180), (1280, 720))
    repeats: int = 5
    spp: tuple[int, ...] = (1, 2, 4, 8, 16)
    paper: bool = True

    def __post_init__(self) -> None:
        for name in ("network_seconds", "repeats"):
            if not 0 < getattr(self, name) < float("inf"):
                raise WorkerError(f"tradeoff {name} must be above 0 and finite, got {getattr(self, name)}")


@dataclass(frozen=True, kw_only=True)
class SweepVariant:
    """One way to make frames.

    Attributes:
        name: of its row and operating point.
        overrides: settings changed from the base.
        network: "own" (trained on its own inputs), "base" (that of the base) or "none".
        precision: of inference; "auto" is resolved by measuring.
        scale: 1, or 2: the network at half the resolution.
        kind: "ours", or "paper", which is compared and not served.
    """

    name: str
    overrides: dict[str, Any]
    network: Literal["own", "base", "none"] = "own"
    precision: str = "auto"
    scale: int = 1
    kind: Literal["ours", "paper"] = "ours"


def sweep_variants(settings: Settings, budget: TradeoffBudget) -> list[SweepVariant]:
    """The sweep around a base, the base first."""
    cache, train = settings.cache, settings.train
    fewer = {
        "elements": {"cache.max_elements": max(1, cache.max_elements // CHEAPER)},
        "samples": {"cache.diffuse_spp": max(1, cache.diffuse_spp // CHEAPER),
                    "cache.directional_spp": max(1, cache.directional_spp // CHEAPER)},
        "directions": {"cache.azimuth": max(1, cache.azimuth // 2), "cache.polar": max(1, cache.polar // 2)},
    }  # fmt: skip
    unshuffle = 2 if train.unshuffle == 4 else 4
    rows = [
        SweepVariant(name=OURS, overrides={}, precision=train.precision),
        SweepVariant(name="fp32", overrides={}, network="base", precision="fp32"),
        SweepVariant(name="bf16", overrides={}, network="base", precision="bf16"),
        SweepVariant(name="1x1 query", overrides={"query.samples": 1}),
        SweepVariant(name="half scale", overrides={"query.samples": 1}, network="base", scale=2),
        SweepVariant(name="narrow network", overrides={"train.widths": _scaled(train.widths, 0.5)}),
        SweepVariant(name="wide network", overrides={"train.widths": _scaled(train.widths, 1.5)}),
        SweepVariant(name=f"unshuffle {unshuffle}", overrides={"train.unshuffle": unshuffle}),
        SweepVariant(name="no network", overrides={}, network="none"),
        SweepVariant(name="no network, 1x1 query", overrides={"query.samples": 1}, network="none"),
        *(SweepVariant(name=f"1/{CHEAPER} {name}", overrides=changes) for name, changes in fewer.items()),
    ]
    if budget.paper:
        rows.append(SweepVariant(name="paper-exact", overrides=PAPER | _PAPER_BUDGET, kind="paper"))
    distinct = {_identity(settings, row): row for row in reversed(rows)}  # the first of equal ones stays
    return [row for row in rows if distinct[_identity(settings, row)] is row]


def _identity(settings: Settings, variant: SweepVariant) -> tuple[Any, ...]:
    """Equal for variants that make the same frames: a preset may already use a cheaper choice."""
    used = settings.override(variant.overrides)
    network: Any = None if variant.network == "none" else (settings if variant.network == "base" else used).train
    is_base_network = variant.network == "base" or used == settings
    return (used.cache, used.query, network, is_base_network, variant.precision, variant.scale)


def _scaled(widths: tuple[int, ...], factor: float) -> tuple[int, ...]:
    """Multiples of 16, as the network asks for."""
    return tuple(max(16, round(width * factor / 16) * 16) for width in widths)


def affordable(settings: Settings, budget: TradeoffBudget) -> Settings:
    """Settings whose training ends within the budget."""
    seconds = settings.train.seconds
    limited = budget.network_seconds if seconds <= 0 else min(seconds, budget.network_seconds)
    return settings.override({"train.seconds": limited})


def trained(run: RunState) -> UnitRef | None:
    """The run's network, where the store has it already; nothing is computed."""
    store: Store = run.store
    frames = run.settings.frames
    elements = run_elements(run)
    inputs = [inputs_ref(run, elements, camera) for camera in run.paths.train]
    renders = [render_ref(run, camera, frames.train_spp) for camera in run.paths.train]
    ref = train_ref(run, inputs, renders)
    return ref if store.committed(ref) is not None else None


def train_variant(run: RunState, program: Any) -> UnitRef:
    """Renders, queries and trains whatever the store lacks of a variant whose caches are baked."""
    elements, frames, paths = run_elements(run), run.settings.frames, run.paths
    parts = []
    for cameras, what in ((paths.train, "training"), (paths.validation, "validation")):
        renders = run_render(run, cameras, frames.train_spp, f"render {what} frames")
        parts.append((run_inputs(run, elements, program, cameras), renders))
    return run_train(run, parts[0], parts[1])


def bake_variant(run: RunState) -> None:
    """Elements and caches of a variant, whatever the store lacks."""
    run_bake(run, run_elements(run))
