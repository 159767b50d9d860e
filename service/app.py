"""The HTTP service: frames of the scenes of one store.

    GET  /v1/scenes                  what can be served
    POST /v1/scenes/{scene}/frame    a frame for a camera, as PNG, JPEG or EXR by Accept
    POST /v1/jobs, GET ...           jobs, where the service runs them (service/routes_jobs.py)
    GET  /healthz                    the process answers

Errors are problem documents (service/problems.py). Frames are rendered one after the other on one thread
(service/rendering.py); bounds on the queue and authentication are not here yet, so listen on loopback.
"""

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Annotated, Any

from fastapi import FastAPI, Header, Response

from service import images
from service.problems import PROBLEM, add_problem_handlers
from service.rendering import Backend, RenderThread, StoreBackend
from service.schemas import DEFAULT_MAX_PIXELS, FrameRequest

if TYPE_CHECKING:
    from service.jobs.service import Jobs

_BINARY = {"schema": {"type": "string", "format": "binary"}}
_PROBLEM_OF_STATUS = {
    400: "the body is no text",
    404: "no such scene",
    406: "Accept allows none of the formats",
    409: "several scenes have this name",
    413: "too many pixels",
    422: "the request or its camera is not valid",
}
FRAME_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "the frame; EXR holds linear scene radiance, PNG and JPEG what a screen shows",
        "content": {media_type: _BINARY for media_type in images.MEDIA_TYPES},
    },
    **{
        status: {"description": description, "content": {PROBLEM: {"schema": {"type": "object"}}}}
        for status, description in _PROBLEM_OF_STATUS.items()
    },
}


def server_timing(seconds: dict[str, float]) -> str:
    """A Server-Timing header's value: "query;dur=12.3, network;dur=4.5", in milliseconds."""
    return ", ".join(f"{name};dur={1e3 * duration_s:.2f}" for name, duration_s in seconds.items())


def _version() -> str:
    try:
        return version("lightwell")
    except PackageNotFoundError:
        return "0"


def create_app(
    store_url: str,
    *,
    make_backend: Callable[[], Backend] | None = None,
    max_pixels: int = DEFAULT_MAX_PIXELS,
    jobs: "Jobs | None" = None,
) -> FastAPI:
    """The service over one store.

    Args:
        store_url: a folder or fsspec URL that holds a store.
        make_backend: what opens scenes instead of the store; called on the render thread.
        max_pixels: the largest frame that is answered.
        jobs: jobs that the service runs; the app starts and closes them.
    """
    rendering = RenderThread(make_backend or (lambda: StoreBackend(store_url)))

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        try:
            await rendering.start()
            if jobs is not None:
                await asyncio.to_thread(jobs.start)
            yield
        finally:
            if jobs is not None:
                await asyncio.to_thread(jobs.close)
            rendering.close()

    app = FastAPI(
        title="Lightwell",
        version=_version(),
        description="Globally lit frames of a 3D scene for any camera pose.",
        lifespan=lifespan,
    )
    add_problem_handlers(app)
    if jobs is not None:
        from service.routes_jobs import add_job_routes

        add_job_routes(app, jobs)

    @app.get("/healthz", summary="The process answers")
    async def healthz() -> dict[str, str]:
        return {"status": "ok"}

    @app.get("/v1/scenes", summary="Scenes that can be served")
    async def list_scenes() -> dict[str, list[dict[str, Any]]]:
        return {"scenes": await rendering.scenes()}

    @app.post(
        "/v1/scenes/{scene}/frame",
        summary="A frame for a camera",
        response_class=Response,
        responses=FRAME_RESPONSES,
    )
    async def frame(scene: str, request: FrameRequest, accept: Annotated[str | None, Header()] = None) -> Response:
        media_type = images.negotiate(accept)
        rendered = await rendering.render(scene, request.to_camera(max_pixels))
        start_s = time.perf_counter()
        content = await asyncio.to_thread(images.encode, rendered.radiance, rendered.exposure, media_type)
        seconds = {**rendered.seconds, "encode": time.perf_counter() - start_s}
        return Response(
            content,
            media_type=media_type,
            headers={
                "Server-Timing": server_timing(seconds),
                "X-Lightwell-Coverage": f"{rendered.coverage:.4f}",
                "X-Lightwell-Exposure": f"{rendered.exposure:.6g}",
                "X-Lightwell-Non-Finite": str(rendered.non_finite),
                "Cache-Control": "no-store",
                "Vary": "Accept",
            },
        )

    return app
