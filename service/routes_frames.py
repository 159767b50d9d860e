"""Scenes and their frames over HTTP.

    GET  /v1/scenes                  what can be served
    POST /v1/scenes/{scene}/frame    a frame for a camera, as PNG, JPEG or EXR by Accept

A frame with NaN or infinity is answered 500 with their number (`non_finite`), never sent and never painted over.
"""

import asyncio
import time
from collections.abc import Coroutine
from typing import Annotated, Any, TypeVar

from fastapi import FastAPI, Header, Request, Response

from service import images
from service.errors import ClientGoneError
from service.frame_choice import point_headers
from service.pictures import Picture, Pictures
from service.problems import PROBLEM
from service.schemas import FrameRequest

T = TypeVar("T")
_BINARY = {"schema": {"type": "string", "format": "binary"}}
_PROBLEM_OF_STATUS = {
    400: "the body is no text",
    404: "no such scene, or its trade was never measured",
    406: "Accept allows none of the formats",
    409: "several scenes have this name",
    413: "too many pixels",
    422: "the request or its camera is not valid, or no operating point meets it (`reachable` names the nearest)",
    500: "the frame is not finite (`non_finite` counts its values), or its scene is damaged",
    503: "too many frames are under way; Retry-After says when to ask again",
    507: "the scene needs more memory than all open scenes may take",
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


async def while_connected(request: Request, work: Coroutine[Any, Any, T]) -> T:
    """The value of `work`, which is cancelled when the client goes away first.

    Raises:
        ClientGoneError: it did.
    """
    working = asyncio.ensure_future(work)
    watching = asyncio.ensure_future(_gone(request))
    try:
        await asyncio.wait((working, watching), return_when=asyncio.FIRST_COMPLETED)
        if not working.done():
            raise ClientGoneError("the client must wait for its answer, but it closed the connection")
        return working.result()
    finally:
        for task in (working, watching):
            task.cancel()


async def _gone(request: Request) -> None:
    """Returns when the connection is closed; the body has been read before."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


def frame_response(picture: Picture) -> Response:
    """A picture with its headers; one that was remembered has no times."""
    response = Response(
        picture.content,
        media_type=picture.media_type,
        headers={
            "X-Lightwell-Coverage": f"{picture.coverage:.4f}",
            "X-Lightwell-Exposure": f"{picture.exposure:.6g}",
            "X-Lightwell-Non-Finite": "0",
            "X-Lightwell-Source": picture.source,
            "ETag": picture.etag,
            "Cache-Control": "no-cache",
            "Vary": "Accept",
        },
    )
    if picture.seconds:
        response.headers["Server-Timing"] = server_timing(picture.seconds)
    return response


def add_frame_routes(app: FastAPI, pictures: Pictures, *, max_pixels: int) -> None:
    """Adds what this module's first lines list.

    Args:
        app: with the problem handlers of `service/problems.py`.
        pictures: makes the frames.
        max_pixels: the largest frame that is answered.
    """
    metrics = pictures.metrics

    @app.get("/v1/scenes", summary="Scenes that can be served", tags=["frames"])
    async def list_scenes() -> dict[str, list[dict[str, Any]]]:
        return {"scenes": await pictures.rendering.catalogue.scenes()}

    @app.post(
        "/v1/scenes/{scene}/frame",
        summary="A frame for a camera",
        tags=["frames"],
        response_class=Response,
        responses=FRAME_RESPONSES,
    )
    async def frame(
        scene: str, body: FrameRequest, request: Request, accept: Annotated[str | None, Header()] = None
    ) -> Response:
        start_s = time.perf_counter()
        media_type = images.negotiate(accept)
        key = await pictures.key(scene, body.to_camera(max_pixels), media_type, body.demand)
        try:
            picture = await while_connected(request, pictures.get(key))
        except ClientGoneError:
            metrics.abandoned.inc()
            raise
        metrics.answered.labels(picture.source).inc()
        metrics.request_seconds.observe(time.perf_counter() - start_s)
        response = frame_response(picture)
        response.headers.update(point_headers(key.frame.point, body.width, body.height))
        return response
