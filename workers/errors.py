"""Errors that workers raise: one root, and one class per noun that a caller may want to tell apart."""

from typing import Any


class WorkerError(Exception):
    """Root of everything that this package raises on purpose."""


class BackendError(WorkerError, RuntimeError):
    """Mitsuba or Dr.Jit cannot run here (no usable LLVM, unknown variant)."""


class SceneError(WorkerError, ValueError):
    """A scene cannot be read, or asks for something that the caches cannot represent."""


class VersionError(WorkerError, ValueError):
    """A run in the store was made by another version of this code."""


class QuarantinedError(WorkerError, ArithmeticError):
    """A unit is over its health limit and was set aside in the store with this reason; a run tries it again.

    Attributes:
        facts: counts and limits that led to it.
    """

    def __init__(self, message: str, facts: dict[str, float] | None = None) -> None:
        super().__init__(message)
        self.facts = facts or {}


class CameraError(WorkerError, ValueError):
    """A camera or a camera path is not usable."""


class StoppedError(WorkerError):
    """Somebody asked for a stop between two passes; what was committed before is kept."""


class ChangedSceneError(WorkerError):
    """A unit was planned for a scene whose files have changed since."""


class OperatingPointError(WorkerError, ValueError):
    """A demand is no demand, or a scene's table cannot be read."""


class NoOperatingPointsError(OperatingPointError):
    """The scene's trade was never measured, or no longer fits the scene's run."""


class UnreachableTargetError(OperatingPointError):
    """No measured point meets the demand.

    Attributes:
        reachable: what comes nearest: "fastest" and "best", each {"point", "ms", "psnr"}.
    """

    def __init__(self, message: str, reachable: dict[str, dict[str, Any]]) -> None:
        super().__init__(message)
        self.reachable = reachable
