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

    from service.config import ServiceConfig
    from service.jobs.service import Jobs

GRACE_S = 10


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


def serve_store(config: "ServiceConfig", preload: Sequence[str] = ()) -> None:
    """Serves until it is interrupted.

    Args:
        config: a new store is made where there is none, for jobs to fill.
        preload: scenes that are opened before the service says that it is ready.

    Raises:
        AccessError: others could reach it and nothing asks for a token.
        SchedulerError: no scheduler answers at the address.
        StorageError: the store cannot be opened or made.
        OptionError: the address cannot be had.
        JobDatabaseError: the job database cannot be used.
    """
    from service.app import create_app
    from service.redaction import redact, redact_logs
    from storage.store import Store

    warning = config.check_exposure()
    Store.open(config.store_url, create=True)
    with bind(config.host, config.port) as listener:
        jobs = _jobs(config)
        server = make_server(create_app(config.store_url, config=config, jobs=jobs, preload=preload))
        redact_logs()  # uvicorn has just made its handlers
        host = f"[{config.host}]" if ":" in config.host else config.host
        url = f"http://{host}:{listener.getsockname()[1]}"
        if warning is not None:
            print(f"lightwell: {warning}", file=sys.stderr)
        print(f"serving {redact(config.store_url)} on {url} (API: {url}/docs)", file=sys.stderr)
        server.run(sockets=[listener])


def _jobs(config: "ServiceConfig") -> "Jobs":
    """Jobs of the store, run by Dask workers: an own cluster's, or those of the scheduler that is named."""
    from service.app import bundle_store
    from service.engine import DaskRunner
    from service.jobs.service import Jobs
    from service.jobs.submission import Desk
    from service.scene_sources import SceneSources

    sources = SceneSources(bundle_store(config), config.scenes_folder)
    desk = Desk(resolve_scene_source=sources.resolve_scene_source, max_pixels=config.max_pixels, max_spp=config.max_spp)
    runner = DaskRunner(config.store_url, config.scheduler, config.workers)
    return Jobs.of_store(config.store_url, runner, desk, config.database_url)


def make_server(app: "FastAPI", log_level: str = "info") -> "uvicorn.Server":
    """A server that says on /readyz that it is stopping as soon as it is told to stop.

    Answers under way are waited for `GRACE_S` seconds; then connections are closed, streams of events among them.
    """
    import uvicorn

    class Server(uvicorn.Server):
        def handle_exit(self, sig: int, frame: "FrameType | None") -> None:
            app.state.readiness.stopping()
            super().handle_exit(sig, frame)

    return Server(uvicorn.Config(app, log_level=log_level, timeout_graceful_shutdown=GRACE_S, server_header=False))
