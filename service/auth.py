"""Who may ask: a bearer token, and without one only pages of this machine.

Without a token the service listens on loopback, where every web page that somebody opens on this machine can send
requests to it, also under a name of its own that it points at 127.0.0.1. Such requests carry the page's name in
Host or Origin, and are refused by it.
"""

import hashlib
import hmac
from urllib.parse import urlsplit

from fastapi import FastAPI
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from service.problems import problem
from service.serving import is_loopback

OPEN_PATHS = frozenset({"/healthz", "/readyz"})
_SAFE_METHODS = {"GET", "HEAD", "OPTIONS"}


class AccessControl:
    """ASGI middleware: 401 without the token, 403 from foreign pages.

    Args:
        app: what answers whoever may ask.
        token: what clients must send; None asks for nothing.
        local_only: without a token, refuse a Host that is not this machine's (the service listens on loopback).
    """

    def __init__(self, app: ASGIApp, token: str | None = None, local_only: bool = False) -> None:
        self._app, self._local_only = app, local_only
        self._expected = _digest(token.encode()) if token is not None else None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
            return
        if scope["type"] != "http" or scope["path"] in OPEN_PATHS:
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        if self._expected is not None:
            if not hmac.compare_digest(_digest(_bearer(scope)), self._expected):
                refusal = problem(401, "request must carry the service's token; send Authorization: Bearer TOKEN")
                refusal.headers["WWW-Authenticate"] = 'Bearer realm="lightwell"'
                await refusal(scope, receive, send)
                return
        elif (reason := self._foreign(headers, scope["method"])) is not None:
            await problem(403, reason)(scope, receive, send)
            return
        await self._app(scope, receive, send)

    def _foreign(self, headers: Headers, method: str) -> str | None:
        """Why a request without a token comes from elsewhere; None where it does not."""
        host = headers.get("host", "")
        if self._local_only and not is_loopback(_host_name(host)):
            return "host must be a name of this machine while there is no token; use localhost"
        origin = headers.get("origin")
        if origin is not None and method not in _SAFE_METHODS and _net_location(origin) != host.lower():
            return "origin must be this service's own page while there is no token"
        return None


def add_access_control(app: FastAPI, token: str | None, *, local_only: bool) -> None:
    """Guards every route but `OPEN_PATHS`. Add it after all other middleware, so that it is asked first."""
    app.add_middleware(AccessControl, token=token, local_only=local_only)


def _bearer(scope: Scope) -> bytes:
    """The token that was sent; empty where there is none, or more than one header."""
    sent = [value for name, value in scope["headers"] if name == b"authorization"]
    if len(sent) != 1:
        return b""
    scheme, _, token = sent[0].strip().partition(b" ")
    return token.strip() if scheme.lower() == b"bearer" else b""


def _digest(token: bytes) -> bytes:
    """Digests are compared, so that time tells neither the token's letters nor its length."""
    return hashlib.sha256(token).digest()


def _host_name(host: str) -> str:
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def _net_location(origin: str) -> str:
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""
