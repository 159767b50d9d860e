"""Open scenes within a budget of bytes, the one used longest ago closed first. Used by the render thread alone."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from cachetools import LRUCache, TTLCache

from service.errors import SceneTooLargeError
from service.scores import human_bytes

if TYPE_CHECKING:
    from workers.camera import Camera
    from workers.operating_points import OperatingPoint
    from workers.renderer import Frame

DEFAULT_MEMORY_NBYTES = 4 * 2**30
FAILURE_S = 5.0
"""So long a scene that could not be opened is refused with the same error: opening takes seconds of everybody's."""
MAX_FAILURES = 256
log = logging.getLogger("lightwell.service")


class Renderer(Protocol):
    """What answers the cameras of one scene: `workers.renderer.FrameRenderer`, or a test's stand-in."""

    @property
    def nbytes(self) -> int:
        """Memory that the open scene holds: caches, geometry, textures, network."""
        ...

    def fit(self, nbytes: int) -> None:
        """Drops what can be opened again until all is within `nbytes` or nothing more can go."""
        ...

    def render(self, camera: "Camera", point: "OperatingPoint | None" = None) -> "Frame": ...


@dataclass(frozen=True)
class SceneKey:
    """A scene and the network that it is served with; another training run makes another key.

    Attributes:
        digest: of the scene's content.
        network: key of the trained network's unit.
    """

    digest: str
    network: str


class OpenScenes:
    """Renderers by scene and network, an LRU by bytes.

    A scene's size is what its renderer says (`Renderer.nbytes`) once it is open, and again when it has opened parts
    of operating points (`restate`). Where it is known from an earlier opening, room is made before the scene is
    loaded; else the process holds the budget and the new scene, or the new parts, for a moment.

    Args:
        open_scene: loads a scene, by digest.
        budget_nbytes: all open scenes together, bytes.
        trim: gives the memory of closed scenes back to the system.
    """

    def __init__(
        self,
        open_scene: Callable[[str], Renderer],
        *,
        budget_nbytes: int = DEFAULT_MEMORY_NBYTES,
        trim: Callable[[], None] = lambda: None,
    ) -> None:
        self._open_scene, self._trim = open_scene, trim
        self.budget_nbytes = budget_nbytes
        self._open: LRUCache[SceneKey, Renderer] = LRUCache(budget_nbytes, getsizeof=lambda scene: scene.nbytes)
        self._nbytes: dict[SceneKey, int] = {}
        self._failures: TTLCache[SceneKey, Exception] = TTLCache(MAX_FAILURES, FAILURE_S, timer=time.monotonic)
        self.num_opened = 0
        self.num_closed = 0

    def __len__(self) -> int:
        return len(self._open)

    @property
    def nbytes(self) -> int:
        """What the open scenes hold."""
        return int(self._open.currsize)

    def get(self, key: SceneKey) -> Renderer:
        """The open scene; loads it where it is not.

        Raises:
            SceneTooLargeError: the scene alone exceeds the budget.
            StorageError, WorkerError: it cannot be loaded.
        """
        renderer = self._open.get(key)
        if renderer is not None:
            return renderer
        if key in self._failures:
            raise self._failures[key].with_traceback(None)
        try:
            return self._load(key)
        except Exception as error:
            self._failures[key] = error
            raise

    def restate(self, key: SceneKey) -> None:
        """Counts an open scene anew, for it may have grown: others are closed for it, and what exceeds the budget
        even then it gives back itself."""
        renderer = self._open.pop(key, None)
        if renderer is None:
            return
        if renderer.nbytes > self.budget_nbytes:
            renderer.fit(self.budget_nbytes)
            self._trim()
        if renderer.nbytes > self.budget_nbytes:
            self.num_closed += 1
            log.warning("closed scene %s: it has outgrown the memory limit", key.digest[:12])
            return
        self._make_room(renderer.nbytes)
        self._open[key] = renderer

    def _load(self, key: SceneKey) -> Renderer:
        for other in [other for other in self._open if other.digest == key.digest]:
            self._close(other)  # replaced by another training run
        known_nbytes = self._nbytes.get(key, 0)
        self._check_size(key, known_nbytes)
        self._make_room(known_nbytes)
        start_s = time.monotonic()
        renderer = self._open_scene(key.digest)
        nbytes = self._nbytes[key] = renderer.nbytes
        try:
            self._check_size(key, nbytes)
        except SceneTooLargeError:
            del renderer
            self._trim()
            raise
        self._make_room(nbytes)
        self._open[key] = renderer
        self.num_opened += 1
        log.info("opened scene %s, %s, in %.1f s", key.digest[:12], human_bytes(nbytes), time.monotonic() - start_s)
        return renderer

    def _check_size(self, key: SceneKey, nbytes: int) -> None:
        if nbytes > self.budget_nbytes:
            raise SceneTooLargeError(
                f"scene must fit the memory for open scenes ({human_bytes(self.budget_nbytes)}), got {key.digest} "
                f"of {human_bytes(nbytes)}; raise the memory limit"
            )

    def _make_room(self, nbytes: int) -> None:
        before = len(self._open)
        while self._open and self._open.currsize + nbytes > self.budget_nbytes:
            oldest = self._open.popitem()[0]  # only the key: the renderer is to be freed here
            self.num_closed += 1
            log.info("closed scene %s to make room", oldest.digest[:12])
        if len(self._open) < before:
            self._trim()

    def _close(self, key: SceneKey) -> None:
        del self._open[key]
        self.num_closed += 1
        self._trim()
        log.info("closed scene %s: another network serves it now", key.digest[:12])
