"""What a reader of one scene format hands to `load_scene`."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from workers.camera import Camera
from workers.errors import SceneError
from workers.world_frame import WorldFrame


@dataclass(kw_only=True)
class SceneDraft:
    """A parsed scene, not yet built.

    Attributes:
        what: names the scene in messages.
        state: Mitsuba's `ParserState`.
        content: (name, sha256 hex) of everything that determines the scene, in a fixed order.
        notes: lines for the user about what was added, changed or ignored.
        make_camera: builds the default camera for (width, height) where the scene has no sensor of its own.
        make_keyframes: builds the keyframes, given the default camera.
        make_test_keyframes: builds the keyframes of the test path, likewise.
        settings: overrides of the run's settings.
        frame: the frame that the reader built the scene in; None: the file's own, still to be judged.
    """

    what: str
    state: Any
    content: list[tuple[str, str]]
    notes: list[str] = field(default_factory=list)
    make_camera: Callable[[int, int], Camera] | None = None
    make_keyframes: Callable[[Camera], tuple[Camera, ...]] | None = None
    make_test_keyframes: Callable[[Camera], tuple[Camera, ...]] | None = None
    settings: dict[str, Any] = field(default_factory=dict)
    frame: WorldFrame | None = None


def file_hash(path: Path) -> str:
    """sha256 hex of a file's bytes.

    Raises:
        SceneError: the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise SceneError(f"file {path.name} must be readable, got: {error.strerror}; check its permissions") from error


def text_hash(text: str) -> str:
    """sha256 hex of a text."""
    return hashlib.sha256(text.encode()).hexdigest()
