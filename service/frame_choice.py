"""Which operating point answers a request for a frame; used by the command line and the service."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from storage.store import Store
    from workers.camera import Camera
    from workers.operating_points import Choice, OperatingPoint, Quality
    from workers.renderer import Frame


FRAME_STEPS = ("query", "network")
"""What `max_ms` bounds: from a pose to the frame in memory. Waiting, opening a scene, what the first frame of a size or
point needs ("prepare") and encoding are told apart in Server-Timing."""


@dataclass(frozen=True, kw_only=True)
class Demand:
    """What was asked for besides pose and size; None is "not given". Falsy where nothing was.

    Attributes:
        quality: "draft", "balanced" or "best".
        max_ms: milliseconds from pose to frame in memory, at most.
        min_psnr: dB at the measured resolution, at least.
    """

    quality: str | None = None
    max_ms: float | None = None
    min_psnr: float | None = None

    def __bool__(self) -> bool:
        return not (self.quality is None and self.max_ms is None and self.min_psnr is None)


def choose_point(
    store: "Store", digest: str, demand: Demand, width: int, height: int, slowdown: float = 1.0
) -> "Choice | None":
    """The measured point, or None where nothing is demanded: then the published run answers.

    Args:
        store: where the scene's table lies.
        digest: of the scene.
        demand: what the frame must be.
        width, height: of the frame, pixels.
        slowdown: how much longer than typical frames take here and now.

    Raises:
        OperatingPointError: the demand is none, or the table cannot be read.
        NoOperatingPointsError: the scene's trade was never measured.
        UnreachableTargetError: no point meets the demand.
    """
    if not demand:
        return None
    from workers.operating_points import FrameDemand, choose
    from workers.operating_table import load_table

    checked = FrameDemand(
        quality=cast("Quality | None", demand.quality), max_ms=demand.max_ms, min_psnr=demand.min_psnr
    )
    return choose(load_table(store, digest).points, checked, width, height, slowdown)


def render_chosen(store: "Store", scene: str, camera: "Camera", demand: Demand) -> "tuple[Frame, Choice | None]":
    """A frame of a scene (name or digest) of a store, and the point that made it.

    Raises:
        StorageError, WorkerError: the scene cannot be opened, or as `choose_point`.
    """
    if not demand:
        from workers.renderer import FrameRenderer

        return FrameRenderer.open(store, scene).render(camera), None
    digest = store.find_scene(scene)["digest"]
    choice = choose_point(store, digest, demand, camera.width, camera.height)
    assert choice is not None  # something is demanded
    from workers.point_renderer import PointRenderer

    return PointRenderer.open(store, digest, warm_up=False).render(camera, choice.point), choice


def point_headers(point: "OperatingPoint | None", width: int, height: int) -> dict[str, str]:
    """How an answer names its point; none where the published run made the frame."""
    if point is None:
        return {}
    return {
        "X-Lightwell-Point": point.name,
        "X-Lightwell-Point-Ms": f"{point.predicted_ms(width, height):.2f}",
        "X-Lightwell-Point-PSNR": f"{point.psnr:.2f}",
    }
