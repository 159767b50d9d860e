"""The compose file: keys that Compose knows, references that resolve, what may reach what, where secrets come from.

Its own JSON schema is in no package that is installed, so the rules that matter here are checked one by one.
"""

import re
from typing import Any

import pytest

from tests.docker.compose_file import ROOT, load

SECRETS = {"LIGHTWELL_TOKEN": "t" * 64, "POSTGRES_PASSWORD": "p", "LIGHTWELL_DATABASE_URL": "postgresql+psycopg://db"}
TOP_KEYS = {"name", "services", "networks", "volumes"}
SERVICE_KEYS = {"image", "build", "command", "entrypoint", "environment", "ports", "volumes", "networks", "depends_on",
                "healthcheck", "deploy", "profiles", "restart", "init", "read_only", "tmpfs", "cap_drop",
                "security_opt"}  # fmt: skip
OURS = "lightwell:local"


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    return load(SECRETS)


@pytest.fixture(scope="module")
def services(compose: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return compose["services"]


def test_keys_are_those_of_the_compose_specification(compose: dict[str, Any]) -> None:
    assert {key for key in compose if not key.startswith("x-")} == TOP_KEYS
    for name, service in compose["services"].items():
        assert set(service) <= SERVICE_KEYS, name
        assert isinstance(service["image"], str) and isinstance(service.get("environment", {}), dict)
        for key in ("command", "entrypoint"):
            assert all(isinstance(part, str) for part in service.get(key, [])), f"{name}: a bare number is not a word"


def test_what_is_asked_for_is_there(services: dict[str, dict[str, Any]]) -> None:
    assert {name for name, service in services.items() if "profiles" not in service} == {
        "service", "scheduler", "worker", "postgres",
    }  # fmt: skip
    assert services["worker"]["deploy"]["replicas"] == 2
    assert {name for name, service in services.items() if service.get("profiles") == ["s3"]} == {"s3", "s3-bucket"}


def test_every_reference_resolves(compose: dict[str, Any], services: dict[str, dict[str, Any]]) -> None:
    for name, service in services.items():
        assert set(service["networks"]) <= set(compose["networks"]), name
        assert {volume.split(":")[0] for volume in service.get("volumes", [])} <= set(compose["volumes"]), name
        for needed, how in service.get("depends_on", {}).items():
            profiles = services[needed].get("profiles")
            assert profiles is None or profiles == service.get("profiles"), f"{name} waits for one that may not start"
            if how["condition"] == "service_healthy":
                assert services[needed].get("healthcheck", {}).get("test"), f"{needed} cannot become healthy"
    used = {volume.split(":")[0] for service in services.values() for volume in service.get("volumes", [])}
    assert used == set(compose["volumes"])


def test_one_image_is_built_from_the_dockerfile_and_others_are_pinned(services: dict[str, dict[str, Any]]) -> None:
    for name, service in services.items():
        if service["image"] == OURS:
            folder = (ROOT / "docker" / service["build"]["context"]).resolve()
            assert (folder / service["build"]["dockerfile"]).is_file(), name
        else:
            assert re.fullmatch(r"[\w./-]+:[\w.-]*\d[\w.-]*", service["image"]), f"{name} must have an exact tag"
            assert "build" not in service


def test_service_and_workers_share_one_store_at_one_path(services: dict[str, dict[str, Any]]) -> None:
    assert services["service"]["volumes"] == services["worker"]["volumes"] == ["store:/data"]
    command = services["service"]["command"]
    assert command[command.index("--store") + 1].startswith("/data/")
    assert load({**SECRETS, "LIGHTWELL_STORE": "s3://a/b"})["services"]["service"]["command"][2] == "s3://a/b"


def test_only_the_service_is_reachable_and_only_from_this_machine(
    compose: dict[str, Any], services: dict[str, dict[str, Any]]
) -> None:
    assert [name for name, service in services.items() if "ports" in service] == ["service"]
    assert services["service"]["ports"] == ["127.0.0.1:8000:8000"]
    assert compose["networks"]["inside"]["internal"] is True
    assert all(service["networks"] == ["inside"] for name, service in services.items() if name != "service")


def test_our_containers_are_hardened(services: dict[str, dict[str, Any]]) -> None:
    for name in ("service", "scheduler", "worker"):
        service = services[name]
        assert service["read_only"] is True and service["cap_drop"] == ["ALL"] and service["init"] is True
        assert "no-new-privileges:true" in service["security_opt"] and "/tmp" in service["tmpfs"]
        assert "privileged" not in service and service["restart"] == "unless-stopped"


@pytest.mark.parametrize("missing", SECRETS)
def test_secrets_come_from_the_environment_file_and_must_be_set(missing: str) -> None:
    with pytest.raises(KeyError, match=r"docker/\.env"):
        load({name: value for name, value in SECRETS.items() if name != missing})
    example = (ROOT / "docker" / "env.example").read_text()
    assert re.search(rf"^{missing}=", example, re.MULTILINE)
    assert "docker/.env" in (ROOT / ".gitignore").read_text().splitlines()


def test_a_container_knows_no_secret_that_it_does_not_need(services: dict[str, dict[str, Any]]) -> None:
    holders = {secret: {name for name, service in services.items() if secret in service.get("environment", {})}
               for secret in SECRETS}  # fmt: skip
    assert holders == {"LIGHTWELL_TOKEN": {"service"}, "LIGHTWELL_DATABASE_URL": {"service"},
                       "POSTGRES_PASSWORD": {"postgres"}}  # fmt: skip


def test_every_variable_of_the_file_is_explained() -> None:
    text = (ROOT / "docker" / "compose.yaml").read_text()
    told = (ROOT / "docker" / "env.example").read_text() + (ROOT / "docs" / "docker.md").read_text()
    assert [name for name in set(re.findall(r"\$\{(\w+)", text)) if name not in told] == []


def test_cuda_file_only_adds_to_services_that_exist(services: dict[str, dict[str, Any]]) -> None:
    cuda = load(SECRETS, "compose.cuda.yaml")["services"]
    assert set(cuda) == {"service", "worker"} <= set(services)
    for service in cuda.values():
        (device,) = service["deploy"]["resources"]["reservations"]["devices"]
        assert device == {"driver": "nvidia", "count": 1, "capabilities": ["gpu"]}
