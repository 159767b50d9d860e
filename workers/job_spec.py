"""What a job asks for, as plain data: it travels to other processes and into the jobs' table."""

import json
from dataclasses import dataclass
from typing import Any

from workers.errors import WorkerError

STAGES = ("bake", "render", "train", "evaluate")


class JobSpecError(WorkerError, ValueError):
    """A job asks for stages that are none."""


@dataclass(frozen=True, kw_only=True)
class JobSpec:
    """One run of the pipeline.

    Attributes:
        scene: what `workers.scene.load_scene` takes: a path that every worker can read, or a built-in name.
        settings: `Settings.to_json()`.
        stages: which of `STAGES` to run; a later one implies those before it.

    Raises:
        JobSpecError: no stage, or one of another name.
    """

    scene: str
    settings: dict[str, Any]
    stages: tuple[str, ...] = STAGES

    def __post_init__(self) -> None:
        object.__setattr__(self, "stages", tuple(self.stages))
        if not self.stages or not set(self.stages) <= set(STAGES):
            raise JobSpecError(
                f"stages must be some of {', '.join(STAGES)}, got {list(self.stages)}; name at least one"
            )

    @property
    def last_stage(self) -> str:
        """The latest stage asked for; the ones before it run too."""
        return max(self.stages, key=STAGES.index)

    @property
    def canonical(self) -> str:
        """One text for every spec that means the same run, whatever its stages."""
        return json.dumps([self.scene, self.settings], sort_keys=True, default=str)
