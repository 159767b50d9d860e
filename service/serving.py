"""The HTTP server's process: a socket that is bound before anything slow starts, then uvicorn."""

import ipaddress
import socket
import sys
from typing import TYPE_CHECKING

from service.errors import OptionError

if TYPE_CHECKING:
    from service.config import ServiceConfig


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
        return socket.create_server((str(address[0]), port), family=family)
    except OSError as error:
        raise OptionError(
            f"address must be free and of this machine, got {host} port {port} ({error.strerror}); "
            "choose another --host or --port"
        ) from None


def serve_store(config: "ServiceConfig") -> None:
    """Serves until it is interrupted.

    Raises:
        AccessError: others could reach it and nothing asks for a token.
        StorageError: there is no store at the URL.
        OptionError: the address cannot be had.
    """
    import uvicorn

    from service.app import create_app
    from service.redaction import redact, redact_logs
    from storage.store import Store

    warning = config.check_exposure()
    Store.open(config.store_url)
    with bind(config.host, config.port) as listener:
        app = create_app(config.store_url, config=config)
        server_config = uvicorn.Config(app, log_level="info", server_header=False)
        redact_logs()  # uvicorn has just made its handlers
        host = f"[{config.host}]" if ":" in config.host else config.host
        url = f"http://{host}:{listener.getsockname()[1]}"
        if warning is not None:
            print(f"lightwell: {warning}", file=sys.stderr)
        print(f"serving {redact(config.store_url)} on {url} (API: {url}/docs)", file=sys.stderr)
        uvicorn.Server(server_config).run(sockets=[listener])
