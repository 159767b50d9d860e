"""One thread that owns Dr.Jit: it opens the scenes of a store and answers cameras, one after the other."""

import asyncio
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from service.errors import AmbiguousSceneError, UnknownSceneError

if TYPE_CHECKING:
    from workers.camera import Camera
    from workers.renderer import Frame

T = TypeVar("T")
MAX_OPEN_SCENES = 4


class Renderer(Protocol):
    """What answers the cameras of one scene: `workers.renderer.FrameRenderer`, or a test's stand-in."""

    def render(self, camera: "Camera") -> "Frame": ...


class Backend(Protocol):
    """Where scenes come from."""

    def scenes(self) -> list[dict[str, Any]]:
        """The scenes that can be served, each with at least "name" and "digest"."""
        ...

    def open(self, digest: str) -> Renderer:
        """Loads one scene, its caches and its network; takes seconds."""
        ...


class StoreBackend:
    """Scenes of a store. Nothing heavy is imported before the first call.

    Args:
        store_url: a folder or fsspec URL that holds a store.

    Raises:
        StorageError: there is no store at the URL.
    """

    def __init__(self, store_url: str) -> None:
        from storage.store import Store

        self._store = Store.open(store_url)

    def scenes(self) -> list[dict[str, Any]]:
        from workers.renderer import renderable_scenes

        return renderable_scenes(self._store)

    def open(self, digest: str) -> Renderer:
        from workers.renderer import FrameRenderer

        return FrameRenderer.open(self._store, digest)


def resolve_scene(scenes: list[dict[str, Any]], name_or_digest: str) -> str:
    """The digest of the one scene that has this name or digest.

    Raises:
        UnknownSceneError: none has it.
        AmbiguousSceneError: several scenes share the name.
    """
    digests = {scene["digest"] for scene in scenes if name_or_digest in (scene["name"], scene["digest"])}
    if not digests:
        names = ", ".join(sorted({scene["name"] for scene in scenes})) or "none yet"
        raise UnknownSceneError(
            f"scene must be one that this store can serve ({names}), got {name_or_digest!r}; "
            "'lightwell run SCENE --store DIR' adds one"
        )
    if len(digests) > 1:
        raise AmbiguousSceneError(
            f"scene must name one scene, got {name_or_digest!r} which {len(digests)} share; "
            f"give a digest: {', '.join(sorted(digests))}"
        )
    return digests.pop()


class RenderThread:
    """Runs every call of a backend on one thread and keeps the scenes used last open.

    Dr.Jit's state belongs to the thread that made it, so the scenes that one thread opened are rendered by it
    alone; requests wait in the order in which they came.

    Args:
        make_backend: called once, on the render thread.
        max_open_scenes: the scene used longest ago is closed when one more is opened.
    """

    def __init__(self, make_backend: Callable[[], Backend], *, max_open_scenes: int = MAX_OPEN_SCENES) -> None:
        self._make_backend = make_backend
        self._max_open_scenes = max_open_scenes
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="lightwell-render")
        self._backend: Backend | None = None
        self._open: OrderedDict[str, Renderer] = OrderedDict()

    async def _call(self, function: Callable[..., T], *arguments: Any) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, function, *arguments)

    async def start(self) -> None:
        """Opens the backend, so that a missing store is reported at once."""
        await self._call(self._get_backend)

    async def scenes(self) -> list[dict[str, Any]]:
        """The scenes that can be served now."""
        return await self._call(lambda: self._get_backend().scenes())

    async def render(self, scene: str, camera: "Camera") -> "Frame":
        """A frame of the scene with this name or digest.

        Raises:
            UnknownSceneError: no such scene.
            AmbiguousSceneError: several scenes of that name.
        """
        return await self._call(self._render, scene, camera)

    def close(self) -> None:
        """Waits for the frame in progress, drops those that wait."""
        self._thread.shutdown(wait=True, cancel_futures=True)

    def _get_backend(self) -> Backend:
        if self._backend is None:
            self._backend = self._make_backend()
        return self._backend

    def _render(self, scene: str, camera: "Camera") -> "Frame":
        return self._renderer(resolve_scene(self._get_backend().scenes(), scene)).render(camera)

    def _renderer(self, digest: str) -> Renderer:
        if digest not in self._open:
            while len(self._open) >= self._max_open_scenes:
                self._open.popitem(last=False)
            self._open[digest] = self._get_backend().open(digest)
        self._open.move_to_end(digest)
        return self._open[digest]
