"""Stage `plan`: the decisions of an adaptive plan, kept as one unit, and the run that follows them."""

import json
import time
from typing import Any

from storage.store import UnitRef
from workers.planner import PLANNER_VERSION, decide
from workers.run_state import RunState
from workers.settings import Settings

STAGE = "plan"
FILE = "plan.json"


def plan_ref(run: RunState) -> UnitRef:
    """The unit that holds a run's plan."""
    return run.ref(STAGE, {"settings": run.settings.to_json(), "version": list(PLANNER_VERSION)})


def planned_run(run: RunState) -> RunState:
    """The run with the settings that its plan decides; the run itself where its settings ask for none.

    The plan is made once for a scene and its settings, and read from the store after that: every process of a job
    works with the same numbers.

    Raises:
        StoppedError: in between, where progress says so.
        StorageError: the stored plan cannot be read.
    """
    if run.settings.plan.mode != "adaptive":
        return run
    ref = plan_ref(run)
    if run.store.committed(ref) is None:
        start = time.perf_counter()
        run.progress.message("plan: audit and pilot bake")
        decision = decide(run, run.progress)
        content = {"overrides": decision.overrides, "choices": [choice.to_json() for choice in decision.choices]}
        run.store.commit(ref, {FILE: json.dumps(content, indent=1).encode()}, {"seconds": time.perf_counter() - start})
    overrides: dict[str, Any] = json.loads(run.store.read(ref, FILE))["overrides"]
    for key, value in overrides.items():
        run.progress.message(f"plan: {key} = {value}")
    result = RunState(run.scene, run.store, applied(run.settings, overrides), run.progress)
    result.table, result.paths = run.table, run.paths  # neither depends on what a plan decides
    return result


def applied(settings: Settings, overrides: dict[str, Any]) -> Settings:
    """Settings with a plan's overrides, marked as such."""
    return settings.override({**overrides, "plan.mode": "applied"})
