"""Errors that workers raise: one root, and one class per noun that a caller may want to tell apart."""


class WorkerError(Exception):
    """Root of everything that this package raises on purpose."""


class BackendError(WorkerError, RuntimeError):
    """Mitsuba or Dr.Jit cannot run here (no usable LLVM, unknown variant)."""


class SceneError(WorkerError, ValueError):
    """A scene cannot be read, or asks for something that the caches cannot represent."""


class CameraError(WorkerError, ValueError):
    """A camera or a camera path is not usable."""


class StoppedError(WorkerError):
    """Somebody asked for a stop between two passes; what was committed before is kept."""


class ChangedSceneError(WorkerError):
    """A unit was planned for a scene whose files have changed since."""
