"""A plan of a scene from end to end: decisions, calibration, cost. Computes no frame and writes nothing."""

import dataclasses
import time
from typing import Any

from storage.store import Store
from workers.plan import Plan
from workers.plan_cost import calibrate, stage_costs
from workers.plan_stage import applied
from workers.planner import decide
from workers.progress import Progress
from workers.run_state import RunState
from workers.scene import Scene
from workers.settings import Settings

_NO_STORE: Store = None  # type: ignore[assignment]  # a plan writes and reads nothing


def make_plan(scene: Scene, settings: Settings) -> Plan:
    """What a run of a scene with some settings would do, and what an adaptive plan makes of it."""
    run = RunState(scene, _NO_STORE, settings, Progress())
    start = time.perf_counter()
    decision = decide(run)
    elements_s = time.perf_counter() - start
    planned = applied(settings, decision.overrides)
    widths = {tuple(each.train.widths) for each in (settings, planned)}
    rates = calibrate(run, decision.element_set, widths, elements_s)
    pilot = {field.name: getattr(decision.pilot, field.name) for field in dataclasses.fields(decision.pilot)
             if field.name != "samples"}  # fmt: skip
    for lobe in ("diffuse", "directional"):
        pilot[lobe] = None if pilot[lobe] is None else dataclasses.asdict(pilot[lobe])
    return Plan(
        choices=decision.choices,
        costs=stage_costs(planned, decision.element_set, rates, decision.pilot),
        preset_costs=stage_costs(settings, decision.element_set, rates, decision.pilot),
        overrides=decision.overrides,
        network_needed=decision.network_needed,
        audit=decision.audit.to_json() | {"elements": dataclasses.asdict(decision.elements)},
        pilot=pilot,
        applies=settings.plan.mode == "adaptive",
    )


def plan_rows(scene: Scene, settings: Settings) -> dict[str, Any]:
    """`make_plan` as JSON."""
    return make_plan(scene, settings).to_json()
