"""What a job asks of the stages: a scene, all settings, and how far along the pipeline to go."""

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
        if not self.stages or tuple(self.stages) != STAGES[: len(self.stages)]:
            raise JobSpecError(
                f"stages must be the first of {', '.join(STAGES)}, in that order, got {list(self.stages)}; "
                "a later stage needs those before it"
            )
