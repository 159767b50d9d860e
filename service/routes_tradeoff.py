"""The measured trade of a scene over HTTP.

    GET /v1/scenes/{scene}/tradeoff    the table as JSON, or its plot as PNG, by Accept

A scene whose trade was never measured is answered 404; `lightwell tradeoff` measures it.
"""

import asyncio
import json
from collections.abc import Awaitable, Callable, Mapping
from typing import Annotated, Any

from fastapi import FastAPI, Header, Response

from service import images
from service.outcome import json_values
from service.problems import PROBLEM

JSON = "application/json"
MEDIA_TYPES = (JSON, images.PNG)
_PROBLEM_SCHEMA = {PROBLEM: {"schema": {"type": "object"}}}
TRADEOFF_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "operating points and all measured rows, or their plot",
        "content": {
            JSON: {"schema": {"type": "object"}},
            images.PNG: {"schema": {"type": "string", "format": "binary"}},
        },
    },
    404: {"description": "no such scene, or its trade was never measured", "content": _PROBLEM_SCHEMA},
    406: {"description": "Accept allows neither JSON nor PNG", "content": _PROBLEM_SCHEMA},
    409: {"description": "several scenes have this name", "content": _PROBLEM_SCHEMA},
}

Resolve = Callable[[str], Awaitable[Mapping[str, Any]]]
ReadTable = Callable[[str], Mapping[str, Any]]


def store_tables(store_url: str) -> ReadTable:
    """Reads operating tables of a store, by digest, as JSON; the store is opened at the first one."""

    def read(digest: str) -> dict[str, Any]:
        from storage.store import Store
        from workers.operating_table import load_table

        return load_table(Store.open(store_url), digest).to_json()

    return read


def add_tradeoff_routes(app: FastAPI, resolve: Resolve, read_table: ReadTable) -> None:
    """Adds what this module's first lines list.

    Args:
        app: with the problem handlers of `service/problems.py`.
        resolve: a scene's entry ("digest") by name or digest; raises UnknownSceneError, AmbiguousSceneError.
        read_table: `store_tables`; called on a thread of its own.
    """

    @app.get(
        "/v1/scenes/{scene}/tradeoff",
        summary="The measured trade of a scene",
        tags=["frames"],
        response_class=Response,
        responses=TRADEOFF_RESPONSES,
    )
    async def tradeoff(scene: str, accept: Annotated[str | None, Header()] = None) -> Response:
        media_type = images.negotiate(accept, MEDIA_TYPES)
        digest = (await resolve(scene))["digest"]
        content = await asyncio.to_thread(_content, read_table, digest, media_type)
        return Response(content, media_type=media_type, headers={"Vary": "Accept", "Cache-Control": "no-cache"})


def _content(read_table: ReadTable, digest: str, media_type: str) -> bytes:
    table = read_table(digest)
    if media_type == JSON:
        return json.dumps(json_values(dict(table)), allow_nan=False).encode()
    from service.tradeoff_plot import tradeoff_plot

    return tradeoff_plot(table["result"])
