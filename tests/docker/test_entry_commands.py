"""The command of every container of ours, parsed as the image would, and the ones that can run here, run."""

import os
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import typer

from service.cli import app
from storage.store import Store
from tests.docker.compose_file import ROOT, command_of, dockerfile_command, load
from tests.docker.test_compose import OURS, SECRETS

SERVICES = {name: service for name, service in load(SECRETS)["services"].items() if service["image"] == OURS}


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]


def parse(arguments: list[str]) -> dict[str, Any]:
    """Parses `lightwell ARGUMENTS` and returns the values; nothing is run."""
    group: Any = typer.main.get_command(app)
    command = group.commands[arguments[0]]
    return command.make_context(arguments[0], list(arguments[1:])).params


@pytest.mark.parametrize("name", [name for name, service in SERVICES.items() if command_of(service)[0] == "lightwell"])
def test_lightwell_commands_of_the_compose_file_can_be_parsed(name: str) -> None:
    command = command_of(SERVICES[name])
    values = parse(command[1:])
    if "--scheduler" in command:
        assert values["scheduler"] == "tcp://scheduler:8786"


def test_default_command_of_the_image_can_be_parsed() -> None:
    assert dockerfile_command("ENTRYPOINT") == ["lightwell"]
    values = parse(dockerfile_command("CMD"))
    assert (values["store"], values["host"], values["port"]) == ("/data/store", "0.0.0.0", 8000)


def test_unknown_options_would_be_refused() -> None:
    with pytest.raises(Exception, match="No such option: --nonsense"):
        parse(["serve", "--store", "x", "--nonsense"])


def test_ports_of_the_compose_file_agree() -> None:
    scheduler, service = command_of(SERVICES["scheduler"]), command_of(SERVICES["service"])
    port = scheduler[scheduler.index("--port") + 1]
    assert f"tcp://scheduler:{port}" in service and f"tcp://scheduler:{port}" in command_of(SERVICES["worker"])
    assert "8787/health" in SERVICES["scheduler"]["healthcheck"]["test"][-1]
    inner = service[service.index("--port") + 1]
    assert SERVICES["service"]["ports"][0].endswith(f":{inner}")
    assert f"127.0.0.1:{inner}/healthz" in (ROOT / "docker" / "Dockerfile").read_text()


def test_python_commands_compile() -> None:
    command = command_of(SERVICES["s3-bucket"])
    assert command[:2] == ["python", "-c"]
    compile(command[2], "s3-bucket", "exec")


@contextmanager
def running(command: list[str], url: str, seconds: float, **environment: str) -> Iterator[bytes]:
    """Starts a container's command with this interpreter and yields what the health check's address answers."""
    process = subprocess.Popen(
        command, cwd=ROOT, env={**os.environ, **environment}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    try:
        end = time.monotonic() + seconds
        while True:
            assert process.poll() is None, process.stdout and process.stdout.read().decode()
            try:
                with urllib.request.urlopen(url, timeout=4) as answer:
                    yield answer.read()
                    return
            except OSError:
                assert time.monotonic() < end, f"{url} did not answer within {seconds:g} s"
                time.sleep(0.3)
    finally:
        process.kill()
        process.communicate()


def test_scheduler_starts_and_its_health_check_passes() -> None:
    command = command_of(SERVICES["scheduler"])
    port, dashboard = free_port(), free_port()
    replaced = {"python": sys.executable, "0.0.0.0": "127.0.0.1", "8786": str(port), ":8787": f"127.0.0.1:{dashboard}"}
    with running([replaced.get(word, word) for word in command], f"http://127.0.0.1:{dashboard}/health", 60) as answer:
        assert answer == b"ok"


def test_service_starts_as_the_image_would_and_its_health_check_passes(tmp_path: Path) -> None:
    Store.open(tmp_path / "store", create=True)
    port = free_port()
    replaced = {"/data/store": str(tmp_path / "store"), "0.0.0.0": "127.0.0.1", "8000": str(port)}
    arguments = [replaced.get(word, word) for word in dockerfile_command("CMD")]
    command = [sys.executable, "-m", "service.cli", *arguments]
    with running(command, f"http://127.0.0.1:{port}/healthz", 120, LIGHTWELL_TOKEN="t" * 64) as answer:
        assert b"ok" in answer
