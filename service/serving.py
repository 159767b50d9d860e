"""The HTTP server's process: a socket that is bound before anything slow starts, then uvicorn."""

import ipaddress
import socket
import sys

from service.errors import OptionError


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


GRACE_S = 5
"""Event streams stay open as long as a job runs: a server that shuts down cuts them after so many seconds."""


def serve_store(store_url: str, host: str, port: int, *, database_url: str | None = None) -> None:
    """Serves until it is interrupted.

    Args:
        store_url: a folder or fsspec URL; a new store is made where there is none, for jobs to fill.
        host, port: where to listen.
        database_url: where jobs are kept; None: an SQLite file in the store's folder.

    Raises:
        StorageError: the store cannot be opened or made.
        OptionError: the address cannot be had.
        JobDatabaseError: the job database cannot be used.
    """
    import uvicorn

    from service.app import create_app
    from service.jobs.service import Jobs
    from service.jobs.submission import Desk
    from service.local_runner import LocalRunner
    from service.scene_names import resolve_builtin_scene
    from storage.store import Store

    Store.open(store_url, create=True)
    with bind(host, port) as listener:
        url = f"http://{f'[{host}]' if ':' in host else host}:{listener.getsockname()[1]}"
        if not is_loopback(host):
            print(
                f"lightwell: {host} can be reached from outside and nothing asks for a password",
                file=sys.stderr,
            )
        print(f"serving {store_url} on {url} (API: {url}/docs)", file=sys.stderr)
        desk = Desk(resolve_scene_source=resolve_builtin_scene)
        jobs = Jobs.of_store(store_url, LocalRunner(store_url), desk, database_url)
        app = create_app(store_url, jobs=jobs)
        config = uvicorn.Config(app, log_level="info", timeout_graceful_shutdown=GRACE_S)
        uvicorn.Server(config).run(sockets=[listener])
