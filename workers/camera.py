"""A pinhole camera as plain data: pose, horizontal field of view, image size.

Convention (Mitsuba's): the camera looks along its +Z, +Y is up and +X points to the *left* of the image.
Pixel (0, 0) is the top left one. The field of view always spans the image's width. A pose may be mirrored
(determinant -1): files written by some exporters rely on it.
"""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workers.errors import CameraError

BYTES_PER_PIXEL = 200  # wavefront state and G-buffer of one primary ray, roughly
_CHECK_MEMORY_ABOVE_PX = 4_000_000
MAX_COORDINATE = 1e18  # scene units; squares still fit single precision
_ORTHONORMAL_TOLERANCE = 1e-3


def available_nbytes() -> int | None:
    """Memory that this process could still allocate, or None where the system does not tell."""
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        return None


def _checked_size(name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise CameraError(f"camera {name} must be a whole number of pixels of at least 1, got {value!r}")
    return int(value)


def _check_memory(width: int, height: int) -> None:
    if width * height <= _CHECK_MEMORY_ABOVE_PX:
        return
    needed, available = width * height * BYTES_PER_PIXEL, available_nbytes()
    if available is not None and needed > available:
        raise CameraError(
            f"camera image must fit in memory ({available / 2**30:.1f} GiB available), got {width}x{height} "
            f"which needs about {needed / 2**30:.1f} GiB; choose a smaller size"
        )


def _vector(name: str, value: ArrayLike) -> NDArray[np.float64]:
    try:
        vector = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        vector = np.empty(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise CameraError(f"camera {name} must be three finite numbers, got {value!r}")
    if np.abs(vector).max() > MAX_COORDINATE:
        raise CameraError(f"camera {name} must be within {MAX_COORDINATE:g} (single precision), got {value!r}")
    return vector


@dataclass(frozen=True, eq=False)
class Camera:
    """One pinhole view.

    Attributes:
        to_world: [4, 4] float64, row-major, camera to world, in scene units; orthonormal axes (no scale).
        fov_deg: field of view across the image's width, degrees, in (0, 180).
        width: image width in pixels.
        height: image height in pixels.

    Raises:
        CameraError: on construction, for any value outside these rules or an image larger than memory.
    """

    to_world: NDArray[np.float64]
    fov_deg: float
    width: int
    height: int

    def __post_init__(self) -> None:
        try:
            matrix = np.array(self.to_world, dtype=np.float64)
        except (TypeError, ValueError):
            matrix = np.empty(0)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise CameraError(f"camera to_world must be 4x4 finite numbers, got {self.to_world!r}")
        if not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-9):
            raise CameraError(f"camera to_world must end in the row 0 0 0 1, got {matrix[3].tolist()}")
        if np.abs(matrix[:3, 3]).max() > MAX_COORDINATE:
            raise CameraError(
                f"camera origin must be within {MAX_COORDINATE:g} (single precision), got {matrix[:3, 3].tolist()}"
            )
        rotation = matrix[:3, :3]
        if not np.allclose(rotation.T @ rotation, np.eye(3), atol=_ORTHONORMAL_TOLERANCE):
            raise CameraError(
                f"camera to_world must have orthonormal axes, got {rotation.round(4).tolist()}; remove scale and shear"
            )
        if isinstance(self.fov_deg, bool) or not isinstance(self.fov_deg, int | float | np.number):
            raise CameraError(f"camera fov_deg must be a number of degrees, got {self.fov_deg!r}")
        if not 0.0 < self.fov_deg < 180.0:
            raise CameraError(f"camera fov_deg must lie between 0 and 180 degrees, got {self.fov_deg}")
        width, height = _checked_size("width", self.width), _checked_size("height", self.height)
        _check_memory(width, height)
        matrix.setflags(write=False)
        for name, value in (("to_world", matrix), ("fov_deg", float(self.fov_deg)), ("width", width),
                            ("height", height)):  # fmt: skip
            object.__setattr__(self, name, value)

    @classmethod
    def look_at(cls, origin: ArrayLike, target: ArrayLike, up: ArrayLike, fov_deg: float,
                width: int, height: int) -> "Camera":  # fmt: skip
        """Camera at `origin` that looks at `target`, both [3] in scene units; `up` need not be orthogonal.

        Raises:
            CameraError: origin equals target, or up is zero or parallel to the view.
        """
        origin, target, up = _vector("origin", origin), _vector("target", target), _vector("up", up)
        forward = target - origin
        distance = float(np.linalg.norm(forward))
        if distance <= 1e-12 * max(1.0, float(np.abs(origin).max())):
            raise CameraError(f"camera target must differ from its origin, got {origin.tolist()} for both")
        forward = forward / distance
        left = np.cross(up, forward)
        length = float(np.linalg.norm(left))
        if length <= 1e-9 * float(np.linalg.norm(up)):
            raise CameraError(f"camera up must not be zero or parallel to the view direction, got {up.tolist()}")
        left = left / length
        to_world = np.eye(4)
        to_world[:3, :4] = np.column_stack([left, np.cross(forward, left), forward, origin])
        return cls(to_world, fov_deg, width, height)

    @property
    def origin(self) -> NDArray[np.float64]:
        """[3] position of the pinhole, scene units."""
        return self.to_world[:3, 3]

    @property
    def forward(self) -> NDArray[np.float64]:
        """[3] unit view direction in world space."""
        return self.to_world[:3, 2]

    @property
    def up(self) -> NDArray[np.float64]:
        """[3] unit vector in world space that points to the image's top."""
        return self.to_world[:3, 1]

    @property
    def world_to_camera(self) -> NDArray[np.float64]:
        """[4, 4] float64, the inverse of `to_world`."""
        return np.linalg.inv(self.to_world).astype(np.float64)

    @property
    def fov_y_deg(self) -> float:
        """Field of view across the image's height, degrees (square pixels)."""
        half_width = np.tan(np.radians(self.fov_deg) / 2)
        return float(np.degrees(2 * np.arctan(half_width * self.height / self.width)))

    def resized(self, width: int, height: int) -> "Camera":
        """The same pose and horizontal field of view at another image size."""
        return Camera(self.to_world, self.fov_deg, width, height)

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values; `from_json` restores an equal camera."""
        return {"to_world": self.to_world.tolist(), "fov_deg": self.fov_deg, "width": self.width,
                "height": self.height}  # fmt: skip

    @classmethod
    def from_json(cls, record: dict[str, Any]) -> "Camera":
        """Inverse of `to_json`.

        Raises:
            CameraError: a key is missing or unknown, or a value breaks a rule.
        """
        keys = {"to_world", "fov_deg", "width", "height"}
        if not isinstance(record, dict) or set(record) != keys:
            got = sorted(record) if isinstance(record, dict) else record
            raise CameraError(f"camera record must have the keys {sorted(keys)}, got {got!r}")
        return cls(**record)

    def _key(self) -> tuple[bytes, float, int, int]:
        return self.to_world.tobytes(), self.fov_deg, self.width, self.height

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Camera) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())
