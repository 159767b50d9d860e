"""Is the process alive, may it get work, and what has it done.

GET /healthz    the process answers
GET /readyz     200 once the warm-up is done; 503 before it, after it failed, and while shutting down
GET /metrics    Prometheus text, or OpenMetrics where Accept asks for it
"""

from enum import StrEnum
from typing import Annotated, Any

from fastapi import FastAPI, Header, Response
from fastapi.responses import JSONResponse
from prometheus_client import CollectorRegistry
from prometheus_client.exposition import choose_encoder

from service.problems import PROBLEM, problem


class Phase(StrEnum):
    """Where in its life the service is."""

    STARTING = "starting"
    READY = "ready"
    FAILED = "failed"
    STOPPING = "stopping"


class Readiness:
    """Whether the service may get work, and why not."""

    def __init__(self) -> None:
        self.phase = Phase.STARTING
        self.reason = "the renderer is warming up"

    def ready(self) -> None:
        """The warm-up is done; a service that is stopping by then stays so."""
        if self.phase is Phase.STARTING:
            self.phase, self.reason = Phase.READY, ""

    def failed(self, reason: str) -> None:
        """The warm-up failed: what was to be preloaded cannot be served."""
        if self.phase is Phase.STARTING:
            self.phase, self.reason = Phase.FAILED, reason

    def stopping(self) -> None:
        """No new work from now on."""
        self.phase, self.reason = Phase.STOPPING, "the service is shutting down"


def add_health_routes(app: FastAPI, readiness: Readiness, registry: CollectorRegistry) -> None:
    """Adds what this module's first lines list."""
    not_ready: dict[int | str, dict[str, Any]] = {
        503: {"description": "not ready, with the reason", "content": {PROBLEM: {"schema": {"type": "object"}}}}
    }

    @app.get("/healthz", summary="The process answers", tags=["health"])
    async def healthz() -> dict[str, str]:
        return {"status": "ok"}

    @app.get("/readyz", summary="The service may get work", tags=["health"], responses=not_ready)
    async def readyz() -> JSONResponse:
        if readiness.phase is Phase.READY:
            return JSONResponse({"status": Phase.READY})
        response = problem(503, readiness.reason, phase=readiness.phase)
        response.headers["Retry-After"] = "1"
        return response

    # No async def: job counts come from a database and are read on a worker thread.
    @app.get(
        "/metrics",
        summary="Counters for Prometheus",
        tags=["health"],
        response_class=Response,
        responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}},
    )
    def metrics(accept: Annotated[str | None, Header()] = None) -> Response:
        encode, content_type = choose_encoder(accept or "")
        return Response(encode(registry), media_type=content_type)
