"""What the stages of one run share: the scene, its store, settings, camera paths, and the keys of its units."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from storage.keys import seed_from_key, unit_key
from storage.store import Store, UnitRef
from workers.camera import Camera
from workers.camera_path import CameraPaths, camera_paths
from workers.progress import Progress
from workers.scene import Scene
from workers.settings import Settings
from workers.surfaces import SurfaceTable, build_surface_table

# Raised whenever a stage's code changes the bytes that the same parameters give.
SCHEMA_VERSION = 1
PATH_SEED = 2024


@dataclass
class RunState:
    """One scene, one store, one set of settings.

    Attributes:
        scene: loaded scene.
        store: where every unit goes.
        settings: checked settings.
        progress: where progress goes.
        seconds: wall seconds of each stage of this run, as they end.
        made: what a stage of this process made and may need again, by key.
    """

    scene: Scene
    store: Store
    settings: Settings
    progress: Progress = field(default_factory=Progress)
    seconds: dict[str, float] = field(default_factory=dict)
    made: dict[str, Any] = field(default_factory=dict)

    @cached_property
    def table(self) -> SurfaceTable:
        return build_surface_table(self.scene.mi_scene, self.scene.frame)

    @cached_property
    def paths(self) -> CameraPaths:
        frames = self.settings.frames
        return camera_paths(
            self.scene, num_train=frames.num_train, num_validation=frames.num_validation, num_test=frames.num_test,
            width=self.settings.width, height=self.settings.height, seed=PATH_SEED,
        )  # fmt: skip

    def ref(self, stage: str, params: dict[str, Any]) -> UnitRef:
        """Reference of the unit whose bytes `params` determine."""
        return UnitRef(self.scene.digest, stage, unit_key(self.scene.digest, stage, params, SCHEMA_VERSION))

    def seed(self, ref: UnitRef, purpose: str = "") -> int:
        """The unit's seed, uint32; derived from its key."""
        return seed_from_key(ref.key, purpose)


def camera_params(camera: Camera) -> dict[str, Any]:
    """A camera as it enters keys."""
    return camera.to_json()
