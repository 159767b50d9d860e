"""The HTTP service: frames of the scenes of one store, and how it fares.

Routes are in service/routes_*.py; errors are problem documents (service/problems.py). Frames are rendered one
after the other on one thread (service/rendering.py). Authentication is not here: listen on loopback.
"""

import asyncio
import logging
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager

from fastapi import FastAPI

from service.failures import known_errors, one_line
from service.metrics import FrameMetrics
from service.pictures import DEFAULT_QUEUE_LIMIT, DEFAULT_RECENT_NBYTES, Pictures
from service.problems import add_problem_handlers
from service.rendering import Backend, RenderThread, StoreBackend
from service.routes_frames import add_frame_routes
from service.routes_health import Readiness, add_health_routes
from service.routes_tradeoff import add_tradeoff_routes, store_tables
from service.scene_cache import DEFAULT_MEMORY_NBYTES
from service.schemas import DEFAULT_MAX_PIXELS
from service.version import package_version

DRAIN_S = 30.0
"""So long frames under way are waited for at shutdown."""
log = logging.getLogger("lightwell.service")


def create_app(
    store_url: str,
    *,
    make_backend: Callable[[], Backend] | None = None,
    max_pixels: int = DEFAULT_MAX_PIXELS,
    queue_limit: int = DEFAULT_QUEUE_LIMIT,
    memory_nbytes: int = DEFAULT_MEMORY_NBYTES,
    recent_nbytes: int = DEFAULT_RECENT_NBYTES,
    preload: Sequence[str] = (),
) -> FastAPI:
    """The service over one store.

    Args:
        store_url: a folder or fsspec URL that holds a store.
        make_backend: what opens scenes instead of the store; called on the render thread.
        max_pixels: the largest frame that is answered.
        queue_limit: frames under way at most; more are answered 503.
        memory_nbytes: of all open scenes together.
        recent_nbytes: of pictures kept to be sent again.
        preload: scenes opened before the service is ready.

    Returns:
        The app; `app.state` has `registry` (of /metrics), `readiness` and `pictures`.
    """
    rendering = RenderThread(
        make_backend or (lambda: StoreBackend(store_url)), budget_nbytes=memory_nbytes, preload=preload
    )
    metrics, readiness = FrameMetrics(), Readiness()
    pictures = Pictures(rendering, metrics, queue_limit=queue_limit, recent_nbytes=recent_nbytes)
    pictures.show()

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        warming = None
        try:
            await rendering.start()
            warming = asyncio.create_task(_warm_up(rendering, readiness))
            yield
            readiness.stopping()
            await pictures.drain(DRAIN_S)
        finally:
            pictures.stop()
            if warming is not None:
                warming.cancel()
            rendering.close()
            pictures.close()

    app = FastAPI(
        title="Lightwell",
        version=package_version(),
        description="Globally lit frames of a 3D scene for any camera pose.",
        lifespan=lifespan,
    )
    app.state.registry, app.state.readiness, app.state.pictures = metrics.registry, readiness, pictures
    add_problem_handlers(app)
    add_health_routes(app, readiness, metrics.registry)
    add_frame_routes(app, pictures, max_pixels=max_pixels)
    add_tradeoff_routes(app, rendering.catalogue.resolve, store_tables(store_url))
    return app


async def _warm_up(rendering: RenderThread, readiness: Readiness) -> None:
    """Frames that come meanwhile wait behind it; what fails is told by /readyz and the log."""
    try:
        await rendering.warm_up()
    except known_errors() as error:
        log.error("warm-up: %s", one_line(error))
        readiness.failed(f"the warm-up failed: {one_line(error)}")
    else:
        readiness.ready()
