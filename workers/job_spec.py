"""What a job asks of the stages: a scene, all settings, and how far along the pipeline to go."""

import json
from dataclasses import dataclass
from typing import Any

from workers.errors import WorkerError

STAGES = ("bake", "render", "train", "evaluate")


class JobSpecError(WorkerError, ValueError):
    """A job's specification is not one that the pipeline can run."""


@dataclass(frozen=True, kw_only=True)
class JobSpec:
    """Everything that determines what a job computes.

    Attributes:
        scene: what `workers.scene.load_scene` takes, a path or a built-in name.
        settings: `Settings.to_json()`.
        stages: a prefix of `STAGES`; a later stage needs those before it.

    Raises:
        JobSpecError: the stages are no prefix of the pipeline.
    """

    scene: str
    settings: dict[str, Any]
    stages: tuple[str, ...] = STAGES

    def __post_init__(self) -> None:
        object.__setattr__(self, "stages", tuple(self.stages))
        if not self.stages or tuple(self.stages) != STAGES[: len(self.stages)]:
            raise JobSpecError(
                f"stages must be the first of {', '.join(STAGES)}, in that order, got {list(self.stages)}; "
                "a later stage needs those before it"
            )

    @property
    def last_stage(self) -> str:
        """The latest stage asked for."""
        return self.stages[-1]

    @property
    def canonical(self) -> str:
        """One text for every spec that means the same run, whatever its stages."""
        return json.dumps([self.scene, self.settings], sort_keys=True, default=str)
