"""What a frame request may hold: pydantic models with their limits, and their conversion to a `Camera`."""

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from service.errors import FrameTooLargeError
from service.frame_choice import Demand

if TYPE_CHECKING:
    from workers.camera import Camera

MAX_SIDE_PX = 16384
DEFAULT_MAX_PIXELS = 3840 * 2160
MAX_COORDINATE = 1e9

Coordinate = Annotated[FiniteFloat, Field(ge=-MAX_COORDINATE, le=MAX_COORDINATE)]
Vector = tuple[Coordinate, Coordinate, Coordinate]
Row = tuple[Coordinate, Coordinate, Coordinate, Coordinate]


class _Strict(BaseModel):
    """Unknown keys are errors: a misspelt option must not be ignored."""

    model_config = ConfigDict(extra="forbid")


class LookAt(_Strict):
    """A pose by what it looks at, in scene units."""

    origin: Vector = Field(description="position of the camera")
    target: Vector = Field(description="a point in the middle of the picture; must differ from origin")
    up: Vector = Field(default=(0.0, 1.0, 0.0), description="which way is up; must not point along the view")


class CameraPose(_Strict):
    """A pose: exactly one of `look_at` and `to_world`. The lens (`fov_deg`) stands beside it, not in it."""

    look_at: LookAt | None = None
    to_world: tuple[Row, Row, Row, Row] | None = Field(
        default=None,
        description="camera to world, 4x4 row-major, Mitsuba's convention (looks along +Z, +Y is up, "
        "+X is the image's left); orthonormal axes, last row 0 0 0 1",
    )

    @model_validator(mode="after")
    def _exactly_one(self) -> "CameraPose":
        if (self.look_at is None) == (self.to_world is None):
            raise ValueError("camera must hold exactly one of look_at and to_world")
        return self


class FrameRequest(_Strict):
    """One frame: a pose, the lens and the size of the picture."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {
                    "camera": {"look_at": {"origin": [0, 2, 5], "target": [0, 0.5, 0], "up": [0, 1, 0]}},
                    "fov_deg": 45,
                    "width": 640,
                    "height": 360,
                }
            ]
        },
    )

    camera: CameraPose
    fov_deg: FiniteFloat = Field(default=45.0, gt=0, lt=180, description="field of view across the width, degrees")
    width: int = Field(default=640, ge=1, le=MAX_SIDE_PX, strict=True, description="pixels")
    height: int = Field(default=360, ge=1, le=MAX_SIDE_PX, strict=True, description="pixels")
    quality: Literal["draft", "balanced", "best"] | None = Field(
        default=None, description="of the operating points that `lightwell tradeoff` measured"
    )
    max_ms: FiniteFloat | None = Field(
        default=None, gt=0, description="a measured point that takes at most so long from pose to frame, milliseconds"
    )
    min_psnr: FiniteFloat | None = Field(default=None, description="a measured point of at least so many dB")

    @property
    def demand(self) -> Demand:
        """What must hold besides pose and size."""
        return Demand(quality=self.quality, max_ms=self.max_ms, min_psnr=self.min_psnr)

    def to_camera(self, max_pixels: int = DEFAULT_MAX_PIXELS) -> "Camera":
        """The camera that this request describes.

        Raises:
            FrameTooLargeError: more than `max_pixels`.
            CameraError: the pose is none (origin equals target, up along the view, axes not orthonormal).
        """
        from workers.camera import Camera

        if self.width * self.height > max_pixels:
            raise FrameTooLargeError(
                f"frame must have at most {max_pixels} pixels, got {self.width}x{self.height}; choose a smaller size"
            )
        pose = self.camera
        if pose.look_at is not None:
            look = pose.look_at
            return Camera.look_at(look.origin, look.target, look.up, self.fov_deg, self.width, self.height)
        assert pose.to_world is not None  # _exactly_one
        return Camera(pose.to_world, self.fov_deg, self.width, self.height)  # type: ignore[arg-type]
