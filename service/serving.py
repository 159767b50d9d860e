"""The HTTP server's process: a socket that is bound before anything slow starts, then uvicorn."""

import ipaddress
import socket
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from service.errors import OptionError

if TYPE_CHECKING:
    from types import FrameType

    import uvicorn
    from fastapi import FastAPI

GRACE_S = 30


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach the address; a name other than localhost counts as reachable."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def bind(host: str, port: int) -> socket.socket:
    """A listening socket.

    Raises:
        OptionError: the address cannot be had (in use, not of this machine, no such name, not allowed).
    """
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.create_server((str(address[0]), port), family=family)
    except OSError as error:
        raise OptionError(
            f"address must be free and of this machine, got {host} port {port} ({error.strerror}); "
            "choose another --host or --port"
        ) from None
    # Accepted sockets inherit it; asyncio sets it only where it made the listener. Without it, the last piece of every
    # answer waits for the client's delayed acknowledgement: 40 ms a frame.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listener


def serve_store(store_url: str, host: str, port: int, preload: Sequence[str] = ()) -> None:
    """Serves until it is interrupted.

    Args:
        store_url: of the store.
        host: address to listen on.
        port: 0 takes a free one.
        preload: scenes that are opened before the service says that it is ready.

    Raises:
        StorageError: there is no store at the URL.
        OptionError: the address cannot be had.
    """
    from service.app import create_app
    from storage.store import Store

    Store.open(store_url)
    with bind(host, port) as listener:
        url = f"http://{f'[{host}]' if ':' in host else host}:{listener.getsockname()[1]}"
        if not is_loopback(host):
            print(
                f"lightwell: {host} can be reached from outside and nothing asks for a password",
                file=sys.stderr,
            )
        print(f"serving {store_url} on {url} (API: {url}/docs)", file=sys.stderr)
        make_server(create_app(store_url, preload=preload)).run(sockets=[listener])


def make_server(app: "FastAPI", log_level: str = "info") -> "uvicorn.Server":
    """A server that says on /readyz that it is stopping as soon as it is told to stop.

    Answers under way are waited for `GRACE_S` seconds; then connections are closed, streams of events among them.
    """
    import uvicorn

    class Server(uvicorn.Server):
        def handle_exit(self, sig: int, frame: "FrameType | None") -> None:
            app.state.readiness.stopping()
            super().handle_exit(sig, frame)

    return Server(uvicorn.Config(app, log_level=log_level, timeout_graceful_shutdown=GRACE_S))
