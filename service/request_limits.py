"""How large a request body may be: counted as it comes in, whatever its headers say."""

from collections.abc import Mapping

from fastapi import FastAPI, HTTPException
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.problems import problem


class BodyLimit:
    """ASGI middleware: 413 where a body is larger than its path allows.

    Args:
        app: what reads the bodies.
        max_nbytes: for every path that is not named.
        max_nbytes_of_path: other limits, by exact path.
    """

    def __init__(self, app: ASGIApp, max_nbytes: int, max_nbytes_of_path: Mapping[str, int] | None = None) -> None:
        self._app, self._max_nbytes, self._of_path = app, max_nbytes, dict(max_nbytes_of_path or {})

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        limit = self._of_path.get(scope["path"], self._max_nbytes)
        reason = f"request body must have at most {limit} bytes"
        declared = Headers(scope=scope).get("content-length", "")
        if declared.isdecimal() and (len(declared) > 18 or int(declared) > limit):
            refusal = problem(413, f"{reason}, got {declared[:40]}")
            refusal.headers["Connection"] = "close"  # the rest of the body is not read
            await refusal(scope, receive, send)
            return
        received = 0

        async def counted() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > limit:
                raise HTTPException(413, f"{reason}, got more", headers={"Connection": "close"})
            return message

        await self._app(scope, counted, send)


def add_body_limit(app: FastAPI, max_nbytes: int, max_nbytes_of_path: Mapping[str, int] | None = None) -> None:
    """Limits the body of every request, in bytes."""
    app.add_middleware(BodyLimit, max_nbytes=max_nbytes, max_nbytes_of_path=max_nbytes_of_path)
