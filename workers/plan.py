"""The record of a plan: choices with reasons, and what they cost. Data only; `workers/planner.py` decides."""

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal


@dataclass(frozen=True, kw_only=True)
class Choice:
    """One line of a plan.

    Attributes:
        item: what is chosen.
        choice: what was chosen.
        reason: why.
        settings: dotted keys that override it; empty for a fact.
        by: "plan", or "you" where such a key was set.
    """

    item: str
    choice: str
    reason: str
    settings: tuple[str, ...] = ()
    by: Literal["plan", "you"] = "plan"

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return dataclasses.asdict(self)


@dataclass(frozen=True, kw_only=True)
class StageCost:
    """What one stage costs.

    Attributes:
        stage: its name.
        paths: camera or element paths that it traces.
        seconds: predicted on this machine.
        nbytes: that it leaves in the store, where it is predicted (caches).
        note: what the prediction rests on.
    """

    stage: str
    paths: int
    seconds: float
    nbytes: int = 0
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What a run would do and cost.

    Attributes:
        choices: with their reasons.
        costs: by stage, with the plan's settings.
        preset_costs: by stage, with the settings as they were given.
        overrides: settings that the plan changes, by dotted key.
        network_needed: whether a network is.
        audit: of scene and elements, as JSON.
        pilot: what the pilot bake found, as JSON.
        applies: whether the settings ask for the plan (`plan.mode`).
    """

    choices: tuple[Choice, ...]
    costs: tuple[StageCost, ...]
    preset_costs: tuple[StageCost, ...]
    overrides: dict[str, Any]
    network_needed: bool
    audit: dict[str, Any]
    pilot: dict[str, Any]
    applies: bool

    def to_json(self) -> dict[str, Any]:
        """ "rows" and "cost" for tables, then everything else; "cost" is that of a run with these settings."""
        planned, preset = _total(self.costs), _total(self.preset_costs)
        rows = [choice.to_json() for choice in self.choices] + [_cost_row(cost) for cost in self.costs]
        return {
            "rows": rows, "cost": planned if self.applies else preset, "planned_cost": planned, "preset_cost": preset,
            "stages": [dataclasses.asdict(cost) for cost in self.costs],
            "preset_stages": [dataclasses.asdict(cost) for cost in self.preset_costs],
            "overrides": self.overrides, "network_needed": self.network_needed, "applies": self.applies,
            "audit": self.audit, "pilot": self.pilot,
        }  # fmt: skip


def _total(costs: tuple[StageCost, ...]) -> dict[str, Any]:
    return {"paths": sum(c.paths for c in costs), "seconds": sum(c.seconds for c in costs),
            "nbytes": sum(c.nbytes for c in costs)}  # fmt: skip


def _cost_row(cost: StageCost) -> dict[str, Any]:
    choice = Choice(item=f"cost: {cost.stage}", choice=f"{cost.seconds:.3g} s", reason=cost.note)
    return choice.to_json()
