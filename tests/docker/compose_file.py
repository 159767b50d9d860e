"""docker/compose.yaml as data: variables filled in as Compose does, and each container's command."""

import json
import re
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[2]
_VARIABLE = re.compile(r"\$\{(\w+)(?::([-?])([^}]*))?\}")


def load(environment: dict[str, str], name: str = "compose.yaml") -> dict[str, Any]:
    """The compose file with `${NAME:-default}` and `${NAME:?message}` replaced.

    Raises:
        KeyError: a required variable is not in the environment.
    """

    def value(match: re.Match[str]) -> str:
        variable, kind, rest = match.groups()
        if environment.get(variable):
            return environment[variable]
        if kind == "?":
            raise KeyError(f"{variable}: {rest}")
        return rest if kind == "-" else ""

    def filled(node: Any) -> Any:
        if isinstance(node, dict):
            return {key: filled(item) for key, item in node.items()}
        if isinstance(node, list):
            return [filled(item) for item in node]
        return _VARIABLE.sub(value, node) if isinstance(node, str) else node

    return filled(yaml.safe_load((ROOT / "docker" / name).read_text()))


def dockerfile_command(kind: str) -> list[str]:
    """ENTRYPOINT or CMD of the image."""
    text = (ROOT / "docker" / "Dockerfile").read_text()
    (arguments,) = re.findall(rf"^{kind} (\[.*\])$", text, re.MULTILINE)
    return json.loads(arguments)


def command_of(service: dict[str, Any]) -> list[str]:
    """What a container of our image runs: its entry point, or the image's, and its arguments."""
    entrypoint = service.get("entrypoint")
    command = service.get("command", [] if entrypoint else dockerfile_command("CMD"))
    return [*(entrypoint or dockerfile_command("ENTRYPOINT")), *command]
