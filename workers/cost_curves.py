"""How costs follow the number of triangles: ours, with a fixed budget of elements, and the paper's, one a triangle.

Every number of triangles and kind of caches is measured in a process of its own (`workers/cost_sample.py`), one after
the other; then all of them query frames in turns. A cost c of n triangles is fitted as c ~ n^k in least squares of
the logarithms; k comes with its standard error.
"""

from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy.stats import linregress

from workers.ablation import PAPER
from workers.cost_sample import CostRequest, CostSample
from workers.errors import WorkerError
from workers.evaluate import commit, machine
from workers.progress import Progress
from workers.scene import Scene
from workers.settings import Settings
from workers.timing import interleaved_medians, other_load
from workers.triangle_count import num_triangles

KINDS: dict[str, dict[str, Any]] = {
    "lattice": {},
    "triangle": {key: value for key, value in PAPER.items() if not key.startswith("train.")},
}
"""Settings of each kind of caches: ours, and the paper's exact ones."""
QUANTITIES = ("elements", "elements_seconds", "bake_paths", "bake_seconds", "nbytes", "memory_nbytes", "query_ms")


@dataclass(frozen=True, kw_only=True)
class CurveBudget:
    """What the curves are measured at, and what that may cost.

    Attributes:
        triangles: numbers of triangles, at least two different ones.
        frame_size: (width, height) of the queried frame, pixels.
        repeats: timed rounds of frames; medians count.
        sample_paths: paths of each lobe that are baked at least; the rest is extrapolated.
        memory_nbytes: larger caches are not opened, and their query not timed.
        overrides: settings changed in every kind, after its own.
    """

    triangles: tuple[int, ...] = (10_000, 100_000, 1_000_000)
    frame_size: tuple[int, int] = (640, 360)
    repeats: int = 7
    sample_paths: int = 6_000_000
    memory_nbytes: int = 4 * 2**30
    overrides: tuple[tuple[str, Any], ...] = ()

    def __post_init__(self) -> None:
        if len(set(self.triangles)) < 2 or min(self.triangles) < 1:
            raise WorkerError(f"triangles must be at least two different numbers above 0, got {self.triangles}")
        for name in ("repeats", "sample_paths", "memory_nbytes"):
            if getattr(self, name) < 1:
                raise WorkerError(f"{name} of cost curves must be at least 1, got {getattr(self, name)}")


class Sample(Protocol):
    """A measured scene that renders frames when asked; `CostSample`, or a test's stand-in."""

    figures: dict[str, Any]

    def frame(self, index: int = 0) -> None: ...

    def close(self) -> None: ...


def run_cost_curves(
    scene: Scene, settings: Settings, budget: CurveBudget, progress: Progress,
    open_sample: Callable[[CostRequest, Callable[[str], None]], Sample] = CostSample,
) -> dict[str, Any]:  # fmt: skip
    """Measures all kinds at all numbers of triangles.

    Args:
        scene: as it was loaded, for its name and count; every sample loads it again.
        settings: ours; `KINDS` change the caches.
        budget: counts and effort.
        progress: told sample by sample.
        open_sample: measures one.

    Returns:
        JSON: "rows" (a kind at a count), "exponents" (`fitted`), what it was measured on, and notes.

    Raises:
        WorkerError: a sample could not be measured.
    """
    requests = [
        (kind, _request(scene, settings, overrides, target, budget))
        for target in sorted(set(budget.triangles))
        for kind, overrides in KINDS.items()
    ]
    with ExitStack() as stack, other_load() as load:
        samples: list[Sample] = []
        with progress.track("cost curves", len(requests)) as advance:
            for kind, request in requests:
                what = f"{kind} at {request.target:,}"
                samples.append(open_sample(request, lambda step, what=what: advance(0.0, f"{what}: {step}")))  # type: ignore[misc]
                stack.callback(samples[-1].close)
                advance(note=what)
        rows = [{"kind": kind, **sample.figures} for (kind, _), sample in zip(requests, samples, strict=True)]
        queried = {
            str(index): sample.frame for index, sample in enumerate(samples)
            if sample.figures["memory_nbytes"] is not None
        }  # fmt: skip
        medians = interleaved_medians(dict(queried), budget.repeats, progress, "time frames")
    for index, row in enumerate(rows):
        row["query_ms"] = 1e3 * medians[str(index)] if str(index) in medians else None
    width, height = budget.frame_size
    return {
        "scene": scene.name, "digest": scene.digest, "triangles": num_triangles(scene.mi_scene),
        "preset": settings.preset, "width": settings.width, "height": settings.height,
        "frame": {"width": width, "height": height}, "repeats": budget.repeats,
        "max_elements": _used(settings, KINDS["lattice"], budget).cache.max_elements,
        "rows": rows, "exponents": fitted(rows), "notes": _notes(rows, budget), "machine": machine(),
        "commit": commit(), "load": load,
    }  # fmt: skip


def _request(
    scene: Scene, settings: Settings, overrides: dict[str, Any], target: int, budget: CurveBudget
) -> CostRequest:
    return CostRequest(
        source=scene.source, settings=_used(settings, overrides, budget).to_json(), target=target,
        frame_size=budget.frame_size, sample_paths=budget.sample_paths, memory_nbytes=budget.memory_nbytes,
    )  # fmt: skip


def _used(settings: Settings, overrides: dict[str, Any], budget: CurveBudget) -> Settings:
    return settings.override(overrides).override(dict(budget.overrides))


def fitted(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Exponents of every kind and quantity.

    Returns:
        {"kind", "quantity", "exponent", "standard_error", "points"} each; the exponent is None where fewer than two
        numbers of triangles have the quantity, its error where fewer than three have it.
    """
    fits = []
    for kind in dict.fromkeys(row["kind"] for row in rows):
        own = [row for row in rows if row["kind"] == kind]
        for quantity in QUANTITIES:
            pairs = ((row["triangles"], row[quantity]) for row in own)
            fits.append({"kind": kind, "quantity": quantity, **_fit(pairs)})
    return fits


def _fit(pairs: Iterable[tuple[int, float | None]]) -> dict[str, Any]:
    logs = np.log([(count, value) for count, value in pairs if value])
    if len(logs) < 2 or np.ptp(logs[:, 0]) == 0:
        return {"exponent": None, "standard_error": None, "points": len(logs)}
    fit = linregress(logs[:, 0], logs[:, 1])
    error = None
    if len(logs) > 2:
        error = float(fit.stderr) if np.ptp(logs[:, 1]) > 0 else 0.0  # of a constant scipy tells NaN
    return {"exponent": float(fit.slope), "standard_error": error, "points": len(logs)}


def _notes(rows: Sequence[dict[str, Any]], budget: CurveBudget) -> list[str]:
    notes = [
        "lattice: our caches, cache.max_elements the same at every count; triangle: the paper's, one element a "
        "triangle that the camera domain sees",
        "tessellated: triangles cut into equal ones, geometry and shading unchanged; vertices clustered: fewer "
        "triangles, geometry coarser, and no careful decimation",
        f"bake seconds and bytes: launches chosen by a seed, at least {budget.sample_paths:,} paths of each lobe where "
        "there are so many, scaled to all",
        "query: caches of the right shape that hold random light; memory: caches, geometry and tree, counted",
    ]
    partial = [row for row in rows if row["sampled_paths"] < 0.999 * row["bake_paths"]]
    if partial:
        share = min(row["sampled_paths"] / row["bake_paths"] for row in partial)
        notes.append(
            f"{len(partial)} of {len(rows)} rows baked a sample, the smallest {100 * share:.2g} % of the paths"
        )
    unopened = [f"{row['kind']} at {row['triangles']:,}" for row in rows if row["memory_nbytes"] is None]
    if unopened:
        limit = budget.memory_nbytes / 2**30
        notes.append(f"not queried, for the caches exceed {limit:.3g} GiB in memory: {', '.join(unopened)}")
    return notes
