"""The server's socket, and a real server on it."""

import signal
import socket
import threading
import time
import urllib.request
from typing import Any

import pytest

from service.app import create_app
from service.errors import OptionError
from service.serving import bind, is_loopback, make_server


@pytest.mark.parametrize(
    ("host", "loopback"),
    [
        ("127.0.0.1", True),
        ("127.9.9.9", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("a.b", False),
    ],
)
def test_is_loopback(host: str, loopback: bool) -> None:
    assert is_loopback(host) is loopback


def test_a_port_in_use_is_an_option_error() -> None:
    with bind("127.0.0.1", 0) as taken, pytest.raises(OptionError, match="choose another --host or --port"):
        bind("127.0.0.1", taken.getsockname()[1])


def test_answers_wait_for_no_acknowledgement() -> None:
    with bind("127.0.0.1", 0) as listener, socket.create_connection(listener.getsockname()):
        accepted, _ = listener.accept()
        with accepted:
            assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) != 0


def test_a_server_told_to_stop_is_not_ready(backend: Any) -> None:
    app = create_app("unused", make_backend=lambda: backend)
    make_server(app).handle_exit(signal.SIGTERM, None)
    assert app.state.readiness.phase == "stopping"


def test_a_bound_socket_is_served(backend: Any) -> None:
    app = create_app("unused", make_backend=lambda: backend)
    with bind("127.0.0.1", 0) as listener:
        assert listener.family == socket.AF_INET
        server = make_server(app, log_level="error")
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        deadline_s = time.monotonic() + 10
        while not server.started and time.monotonic() < deadline_s:
            time.sleep(0.01)
        url = f"http://127.0.0.1:{listener.getsockname()[1]}/healthz"
        body = urllib.request.build_opener(urllib.request.ProxyHandler({})).open(url, timeout=10).read()
        server.should_exit = True
        thread.join(10)
    assert body == b'{"status":"ok"}' and not thread.is_alive()
