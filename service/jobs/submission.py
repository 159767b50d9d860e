"""From a request to a checked specification: everything that can be wrong is said before the job is queued."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from service.errors import JobRequestError
from service.jobs.schemas import JobRequest, PlanRequest
from service.jobs.table import Submission

if TYPE_CHECKING:
    from workers.scene_request import SceneRequest
    from workers.settings import Settings

ResolveScene = Callable[[str], str]
"""A scene's name to what `workers.scene.load_scene` takes; raises UnknownSceneError."""


def _read_scene_request(source: str) -> "SceneRequest":
    from workers.scene_request import read_scene_request

    return read_scene_request(source)


@dataclass(frozen=True, kw_only=True)
class Desk:
    """Where requests are checked.

    Attributes:
        resolve_scene_source: a scene's name to its source.
        read_scene: reads what the scene's file asks for.
        max_pixels: of one frame.
        max_spp: paths per pixel of any frame.
    """

    resolve_scene_source: ResolveScene
    read_scene: "Callable[[str], SceneRequest]" = _read_scene_request
    max_pixels: int = 3840 * 2160
    max_spp: int = 65_536

    def plan(self, request: PlanRequest) -> "tuple[str, Settings]":
        """The scene's source and the settings of a request; reads the scene's file, so it may take a second.

        Raises:
            UnknownSceneError: no such scene.
            SceneError: the scene's file cannot be used.
            SettingsError: an unknown preset or setting, or a value out of its range.
            JobRequestError: more pixels or paths than this service computes.
        """
        from workers.settings import Settings

        if "preset" in request.settings:
            raise JobRequestError("preset must be given beside settings, got it in them")
        settings = Settings.preset_named(request.preset).override(dict(request.settings))
        source = self.resolve_scene_source(request.scene)
        wish = self.read_scene(source)
        size = {"width": wish.width, "height": wish.height}
        settings = Settings.preset_named(request.preset).choose({**size, **wish.settings, **request.settings})
        self._check_size(settings)
        return source, settings

    def submission(self, request: JobRequest) -> Submission:
        """The job that a request asks for.

        Raises:
            JobSpecError: the stages are no prefix of the pipeline.
            UnknownSceneError, SceneError, SettingsError, JobRequestError: as `plan`.
        """
        from workers.job_spec import JobSpec

        stages = tuple(request.stages)
        JobSpec(scene=request.scene, settings={}, stages=stages)  # wrong stages are said before a file is read
        source, settings = self.plan(request)
        spec = JobSpec(scene=source, settings=settings.to_json(), stages=stages)
        asked = request.model_dump(mode="json")
        return Submission(
            request=asked, spec=asdict(spec), request_digest=_digest(asked), priority=request.priority,
            spec_digest=_digest({"scene": spec.scene, "settings": spec.settings}),
        )  # fmt: skip

    def _check_size(self, settings: "Settings") -> None:
        if settings.width * settings.height > self.max_pixels:
            raise JobRequestError(
                f"frames must have at most {self.max_pixels} pixels, got {settings.width}x{settings.height}; "
                "set width and height"
            )
        spp = max(settings.frames.train_spp, settings.frames.test_spp, *settings.evaluation.spp)
        if spp > self.max_spp:
            raise JobRequestError(f"frames must have at most {self.max_spp} paths a pixel, got {spp}")


def _digest(value: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
