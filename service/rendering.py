"""One thread that owns Dr.Jit: it opens the scenes of a store and answers cameras, one after the other.

Dr.Jit's state belongs to the thread that made it, so the scenes that one thread opened are rendered by it alone;
calls wait in the order in which they came. While a scene is opened (seconds) every other frame waits.
"""

import asyncio
import logging
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from service.catalogue import Catalogue, Entry
from service.frame_choice import FRAME_STEPS, Demand, choose_point
from service.pace import Pace
from service.scene_cache import DEFAULT_MEMORY_NBYTES, OpenScenes, Renderer, SceneKey

if TYPE_CHECKING:
    from workers.camera import Camera
    from workers.operating_points import OperatingPoint
    from workers.renderer import Frame

T = TypeVar("T")
log = logging.getLogger("lightwell.service")


class Backend(Protocol):
    """Where scenes come from."""

    def scenes(self) -> list[Entry]:
        """The scenes that can be served, each with at least "name", "digest" and "network". Called on any thread."""
        ...

    def warm_up(self) -> None:
        """Imports and starts what the first scene would otherwise wait for; takes seconds."""
        ...

    def open(self, digest: str) -> Renderer:
        """Loads one scene, its caches and its network; takes seconds."""
        ...

    def choose(self, digest: str, demand: Demand, width: int, height: int, slowdown: float = 1.0) -> "OperatingPoint":
        """The measured point of a scene that meets a demand where frames take `slowdown` times as long as measured.
        Called on any thread."""
        ...

    def trim(self) -> None:
        """Gives the memory of closed scenes back to the system."""
        ...


class StoreBackend:
    """Scenes of a store. Nothing heavy is imported before `warm_up` or `open`.

    Args:
        store_url: a folder or fsspec URL that holds a store.
        compile: try a compiled network for each frame size of the published runs (tens of seconds once a size).

    Raises:
        StorageError: there is no store at the URL.
    """

    def __init__(self, store_url: str, *, compile: bool = False) -> None:
        from storage.store import Store

        self._store, self._compile = Store.open(store_url), compile

    def scenes(self) -> list[Entry]:
        from workers.published import renderable_scenes

        return renderable_scenes(self._store)

    def warm_up(self) -> None:
        import workers.point_renderer  # noqa: F401  # starts Mitsuba and torch

    def open(self, digest: str) -> Renderer:
        from workers.point_renderer import PointRenderer

        renderer = PointRenderer.open(self._store, digest, compile=self._compile)
        log.info("scene %s: network %s", digest[:12], renderer.reconstructor.choices)
        return renderer

    def choose(self, digest: str, demand: Demand, width: int, height: int, slowdown: float = 1.0) -> "OperatingPoint":
        choice = choose_point(self._store, digest, demand, width, height, slowdown)
        assert choice is not None  # something is demanded
        return choice.point

    def trim(self) -> None:
        from workers.footprint import release_freed

        release_freed()


@dataclass(frozen=True)
class FrameKey:
    """Everything that decides a frame: the scene's content, the network that serves it, pose, lens and size; and the
    measured operating point, None for the published run."""

    scene: SceneKey
    camera: "Camera"
    point: "OperatingPoint | None" = None


@dataclass(frozen=True)
class Rendered:
    """A frame, and the seconds that it waited for the thread ("queue"), took to open its scene ("open") and to open or
    compile what it is the first to need ("prepare"), query and network."""

    frame: "Frame"
    seconds: dict[str, float]

    @property
    def frame_s(self) -> float:
        """Seconds from pose to frame in memory, which `max_ms` bounds."""
        return sum(self.frame.seconds.get(step, 0.0) for step in FRAME_STEPS)


class RenderThread:
    """The thread, its backend and its open scenes.

    Args:
        make_backend: called once, on the render thread.
        budget_nbytes: memory of all open scenes together.
        preload: names or digests of scenes that are opened before the service is ready.
    """

    def __init__(
        self, make_backend: Callable[[], Backend], *, budget_nbytes: int = DEFAULT_MEMORY_NBYTES,
        preload: Sequence[str] = (),
    ) -> None:  # fmt: skip
        self._make_backend, self._preload = make_backend, tuple(preload)
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="lightwell-render")
        self._calls: set[Future[Any]] = set()
        self._backend: Backend | None = None
        self.pace = Pace()
        self.catalogue = Catalogue(lambda: self._opened_backend().scenes())
        self.scenes = OpenScenes(
            lambda digest: self._opened_backend().open(digest),
            budget_nbytes=budget_nbytes,
            trim=lambda: self._opened_backend().trim(),
        )

    async def start(self) -> None:
        """Opens the backend, so that a missing store is reported at once."""
        self._backend = await self._call(self._make_backend)

    async def warm_up(self) -> None:
        """Imports what is heavy and opens the scenes that were asked for.

        Raises:
            UnknownSceneError, AmbiguousSceneError, StorageError, WorkerError: a scene to preload cannot be opened.
        """
        await self._call(self._opened_backend().warm_up)
        for name in self._preload:
            await self._call(self.scenes.get, scene_key(await self.catalogue.resolve(name)))

    async def choose(self, digest: str, demand: Demand, camera: "Camera") -> "OperatingPoint | None":
        """The operating point that meets a demand, None where nothing is demanded; beside the thread, not on it.

        Raises:
            NoOperatingPointsError: the scene's trade was never measured.
            UnreachableTargetError: no point meets the demand.
        """
        if not demand:
            return None
        slowdown = self.pace.slowdown(digest)
        choose = self._opened_backend().choose
        return await asyncio.to_thread(choose, digest, demand, camera.width, camera.height, slowdown)

    async def render(self, key: FrameKey) -> Rendered:
        """The frame of a key. Cancelled before the thread came to it, it is never begun."""
        rendered = await self._call(self._render, key, time.perf_counter())
        if key.point is not None:
            typical_ms = key.point.typical_ms(key.camera.width, key.camera.height)
            self.pace.note(key.scene.digest, 1e3 * rendered.frame_s / typical_ms)
        return rendered

    def close(self) -> None:
        """Waits for the frame in progress, drops those that wait."""
        self._thread.shutdown(wait=True, cancel_futures=True)

    @property
    def num_waiting(self) -> int:
        """Calls that the thread has not come to."""
        return sum(not call.running() for call in tuple(self._calls))

    async def _call(self, function: Callable[..., T], *arguments: Any) -> T:
        call = self._thread.submit(function, *arguments)
        self._calls.add(call)
        call.add_done_callback(self._calls.discard)
        return await asyncio.wrap_future(call)

    def _opened_backend(self) -> Backend:
        if self._backend is None:
            raise RuntimeError("RenderThread must be started before it is used; await start()")
        return self._backend

    def _render(self, key: FrameKey, asked_s: float) -> Rendered:
        started_s = time.perf_counter()
        num_opened = self.scenes.num_opened
        renderer = self.scenes.get(key.scene)
        seconds = {"queue": started_s - asked_s}
        if self.scenes.num_opened > num_opened:
            seconds["open"] = time.perf_counter() - started_s
        if key.point is None:
            frame = renderer.render(key.camera)
        else:
            frame = renderer.render(key.camera, key.point)
            self.scenes.restate(key.scene)
        return Rendered(frame, seconds | frame.seconds)


def scene_key(entry: Entry) -> SceneKey:
    """What identifies a catalogue entry's scene among the open ones."""
    return SceneKey(entry["digest"], entry["network"])
