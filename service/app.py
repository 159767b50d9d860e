"""The HTTP service: frames of the scenes of one store.

    GET  /v1/scenes                  what can be served
    POST /v1/scenes/{scene}/frame    a frame for a camera, as PNG, JPEG or EXR by Accept
    GET  /healthz                    the process answers
    /v1/bundles                      uploaded scenes (service/routes_bundles.py)

Errors are problem documents (service/problems.py). Frames are rendered one after the other on one thread
(service/rendering.py). Who may ask and how much is in service/auth.py and service/request_limits.py.
"""

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from importlib.metadata import PackageNotFoundError, version
from typing import Annotated, Any

from fastapi import FastAPI, Header, Response

from service import images
from service.auth import add_access_control
from service.bundle_archive import ArchiveLimits
from service.bundle_rules import SceneLimits
from service.bundles import BundleStore
from service.config import ServiceConfig
from service.problems import PROBLEM, add_problem_handlers
from service.redaction import register_secrets
from service.rendering import Backend, RenderThread, StoreBackend
from service.request_limits import add_body_limit
from service.routes_bundles import FORM_OVERHEAD_NBYTES, UPLOAD_PATH, add_bundle_routes
from service.schemas import DEFAULT_MAX_PIXELS, FrameRequest
from service.serving import is_loopback

_BINARY = {"schema": {"type": "string", "format": "binary"}}
_PROBLEM_OF_STATUS = {
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
    config: ServiceConfig | None = None,
) -> FastAPI:
    """The service over one store.

    Args:
        store_url: a folder or fsspec URL that holds a store.
        make_backend: what opens scenes instead of the store; called on the render thread.
        max_pixels: the largest frame that is answered.
        config: adds bundles, access control and limits of request bodies (and decides `max_pixels`).
    """
    if config is not None:
        max_pixels = config.max_pixels
    rendering = RenderThread(make_backend or (lambda: StoreBackend(store_url)))

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        try:
            await rendering.start()
            yield
        finally:
            rendering.close()

    app = FastAPI(
        title="Lightwell",
        version=_version(),
        description="Globally lit frames of a 3D scene for any camera pose.",
        lifespan=lifespan,
    )
    add_problem_handlers(app)

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

    if config is not None:
        _add_configured(app, config)
    return app


def _add_configured(app: FastAPI, config: ServiceConfig) -> None:
    """Bundles, then what stands before every route: limits, and outermost who may ask."""
    register_secrets(config.secrets())
    add_bundle_routes(app, bundle_store(config), config.upload_max_nbytes)
    add_body_limit(
        app, config.body_max_nbytes, {UPLOAD_PATH: config.upload_max_nbytes + FORM_OVERHEAD_NBYTES}
    )  # fmt: skip
    token = config.token.get_secret_value() if config.token is not None else None
    add_access_control(app, token, local_only=is_loopback(config.host))


def bundle_store(config: ServiceConfig) -> BundleStore:
    """The uploaded bundles of a configuration."""
    return BundleStore(
        config.bundles_path,
        ArchiveLimits(
            max_nbytes=config.upload_max_unpacked_nbytes,
            max_files=config.upload_max_files,
            max_ratio=config.upload_max_ratio,
        ),
        SceneLimits(max_pixels=config.max_pixels, max_spp=config.max_spp, max_depth=config.max_depth),
    )
