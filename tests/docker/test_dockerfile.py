"""The Dockerfile by the rules that hadolint would check, and by what the image must be. No Docker engine is needed."""

import fnmatch
import json
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
Instruction = tuple[str, str]


def instructions() -> list[Instruction]:
    """(instruction, arguments) with continued lines joined and comments removed."""
    text = (ROOT / "docker" / "Dockerfile").read_text()
    lines = "\n".join(line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#"))
    joined = re.sub(r"\\\n\s*", " ", lines)
    return [(name.upper(), rest.strip()) for name, _, rest in (line.partition(" ") for line in joined.splitlines())]


def stages() -> list[list[Instruction]]:
    found: list[list[Instruction]] = []
    for instruction in instructions():
        if instruction[0] == "FROM":
            found.append([])
        if found:
            found[-1].append(instruction)
    return found


def of_kind(kind: str, stage: list[Instruction]) -> list[str]:
    return [arguments for name, arguments in stage if name == kind]


def ignored(path: str) -> bool:
    """Whether .dockerignore keeps a path out: the last pattern that matches it, or a folder above it, wins."""
    result = False
    for line in (ROOT / ".dockerignore").read_text().splitlines():
        pattern = line.strip().removeprefix("!").removeprefix("**/")
        if not pattern or line.startswith("#"):
            continue
        parts = path.split("/")
        above = ["/".join(parts[:count]) for count in range(1, len(parts) + 1)]
        if any(fnmatch.fnmatch(name, pattern) or ("**/" in line and fnmatch.fnmatch(name.split("/")[-1], pattern))
               for name in above):  # fmt: skip
            result = not line.startswith("!")
    return result


def test_bases_are_pinned_slim_and_of_a_python_that_the_project_allows() -> None:
    bases = [arguments.split()[0] for name, arguments in instructions() if name == "FROM"]
    assert len(bases) == 2, "a build stage and a runtime stage"
    required = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["requires-python"]
    for base in bases:
        match = re.fullmatch(r"python:(\d+)\.(\d+)\.(\d+)-slim-[a-z]+", base)
        assert match, f"{base} must name an exact version, not latest"
        assert f">={match[1]}.{match[2]}" == required


def test_every_copied_path_exists_and_is_not_ignored() -> None:
    packages = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    copied = [source for arguments in of_kind("COPY", stages()[0]) for source in arguments.split()[:-1]]
    assert {name.split(".")[0] for name in packages} <= set(copied)
    for source in copied:
        assert (ROOT / source).exists(), source
        assert not ignored(source), source
    assert of_kind("COPY", stages()[1]) == ["--from=build /opt/lightwell /opt/lightwell"]


@pytest.mark.parametrize("path", [
    ".git/config", ".venv/bin/python", "tests/conftest.py", "docker/.env", "store/store.json", "shared/scenes/a.xml",
    "service/__pycache__/cli.pyc", "docs/docker.md",
])  # fmt: skip
def test_build_context_holds_no_history_environment_secret_or_result(path: str) -> None:
    assert ignored(path)


def test_build_context_holds_the_code() -> None:
    assert not any(ignored(path) for path in ("service/cli.py", "service/templates/report.html", "pyproject.toml"))


def test_final_stage_runs_as_a_numbered_user_that_is_not_root() -> None:
    users = of_kind("USER", stages()[-1])
    assert users and re.fullmatch(r"([1-9]\d*):([1-9]\d*)", users[-1]), "a number: Kubernetes can check it"
    names = [name for name, _ in stages()[-1]]
    assert "RUN" not in names[names.index("USER") :]
    assert f"--uid {users[-1].split(':')[0]} " in " ".join(of_kind("RUN", stages()[-1]))


def test_apt_leaves_no_lists_and_no_recommended_packages() -> None:
    for arguments in (arguments for name, arguments in instructions() if name == "RUN" and "apt-get" in arguments):
        assert "apt-get update" in arguments and "--no-install-recommends" in arguments and "--yes" in arguments
        assert "rm -rf /var/lib/apt/lists/*" in arguments
        assert not re.search(r"\b(sudo|apt|upgrade|dist-upgrade)\s", arguments.replace("apt-get", ""))


def test_pip_keeps_no_cache_and_follows_the_constraints() -> None:
    build = stages()[0]
    assert any("PIP_NO_CACHE_DIR=1" in arguments for arguments in of_kind("ENV", build))
    installs = [part for arguments in of_kind("RUN", build) for part in arguments.split("&&") if "pip install" in part]
    assert installs and all("-c constraints.txt" in part for part in installs)
    assert "constraints-cpu.txt" in " ".join(of_kind("RUN", build))


def test_image_builds_for_cpu_unless_an_argument_says_otherwise() -> None:
    assert "TORCH=cpu" in of_kind("ARG", stages()[0])
    assert "VARIANT=llvm_ad_rgb" in of_kind("ARG", stages()[1])
    backend = (ROOT / "workers" / "backend.py").read_text()
    assert "LIGHTWELL_VARIANT" in backend and "cuda_ad_rgb" in backend
    assert any("LIGHTWELL_VARIANT=${VARIANT}" in arguments for arguments in of_kind("ENV", stages()[1]))


def test_no_secret_and_no_index_enters_the_final_stage() -> None:
    text = " ".join(arguments for _, arguments in stages()[-1])
    assert not re.search(r"TOKEN|PASSWORD|SECRET|INDEX_URL", text)
    assert not re.search(r"https?://(?!127\.0\.0\.1)", " ".join(arguments for _, arguments in instructions()))


def test_commands_are_in_exec_form_and_the_health_check_asks_healthz() -> None:
    final = stages()[-1]
    (check,), (entry,), (command,) = (of_kind(kind, final) for kind in ("HEALTHCHECK", "ENTRYPOINT", "CMD"))
    test = json.loads(check.partition(" CMD ")[2])
    assert test[0] == "python" and "/healthz" in test[-1]
    assert json.loads(entry) == ["lightwell"]
    assert json.loads(command)[:3] == ["serve", "--store", "/data/store"]
    assert of_kind("WORKDIR", final) == ["/data"] and "ADD" not in [name for name, _ in instructions()]


def test_library_that_the_slim_image_lacks_is_installed() -> None:
    assert "libatomic1" in " ".join(of_kind("RUN", stages()[-1])), "karellen-llvm-core's libLLVM loads libatomic.so.1"
