# ruff: noqa: E501  # tables are read by the row
"""Who may ask, how much, and that nobody reads a secret."""

import logging
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any

import pytest
import uvicorn
from fastapi.testclient import TestClient

from service import redaction
from service.app import create_app
from service.config import ServiceConfig, load_config
from service.errors import AccessError, OptionError
from service.problems import problem
from service.redaction import RedactingFilter, redact, redact_logs, register_secrets
from service.serving import bind

TOKEN = "correct-horse-battery-staple"
BEARER = {"Authorization": f"Bearer {TOKEN}"}


@pytest.fixture(autouse=True)
def forget_secrets() -> Iterator[None]:
    yield
    redaction._secrets.clear()


def make_client(backend: Any, tmp_path: Any, called: str = "localhost", **values: Any) -> TestClient:
    config = ServiceConfig(store_url=str(tmp_path / "store"), **values)
    app = create_app(config.store_url, make_backend=lambda: backend, config=config)
    return TestClient(app, base_url=f"http://{called}", raise_server_exceptions=False)


@pytest.fixture
def guarded(backend: Any, tmp_path: Any) -> Iterator[TestClient]:
    with make_client(backend, tmp_path, "example.org", token=TOKEN, host="0.0.0.0") as client:
        yield client


def routes_of(client: TestClient) -> list[tuple[str, str]]:
    paths = client.app.openapi()["paths"]  # type: ignore[attr-defined]
    return [(method, path) for path, methods in paths.items() for method in methods]


def test_every_route_but_health_wants_the_token(guarded: TestClient) -> None:
    asked = [
        *routes_of(guarded),
        ("get", "/docs"),
        ("get", "/openapi.json"),
        ("get", "/no/such"),
        ("put", "/v1/scenes"),
    ]
    assert ("post", "/v1/bundles") in asked
    for method, path in asked:
        response = guarded.request(method, path)
        if path in ("/healthz", "/readyz"):
            assert response.status_code == 200
            continue
        assert response.status_code == 401, (method, path)
        assert response.headers["www-authenticate"] == 'Bearer realm="lightwell"'
        assert response.headers["content-type"] == "application/problem+json"
        assert TOKEN not in response.text


@pytest.mark.parametrize(
    "sent",
    [
        "", "Bearer", "Bearer ", f"Bearer {TOKEN}x", f"Bearer {TOKEN[:-1]}", f"Basic {TOKEN}", TOKEN, f"Bearer  x{TOKEN}",
        f"Bearer {TOKEN.upper()}", f"Bearer {TOKEN}, Bearer {TOKEN}", b"Bearer \xff\xfe", f"bearer:{TOKEN}",
    ],
)  # fmt: skip
def test_other_credentials_are_401(guarded: TestClient, sent: Any) -> None:
    assert guarded.get("/v1/scenes", headers={"Authorization": sent}).status_code == 401


def test_two_credentials_are_401(guarded: TestClient) -> None:
    headers = [("Authorization", "Bearer x"), ("Authorization", f"Bearer {TOKEN}")]
    assert guarded.get("/v1/scenes", headers=headers).status_code == 401


@pytest.mark.parametrize(
    "path", ["/healthz/", "//healthz", "/healthz/../v1/scenes", "/v1/scenes?x=/healthz", "/HEALTHZ"]
)
def test_paths_like_the_open_ones_are_not_open(guarded: TestClient, path: str) -> None:
    assert guarded.get(path, follow_redirects=False).status_code == 401


def test_the_token_opens_and_its_scheme_ignores_case(guarded: TestClient) -> None:
    assert guarded.get("/v1/scenes", headers=BEARER).status_code == 200
    assert guarded.get("/v1/scenes", headers={"Authorization": f"bearer {TOKEN}"}).status_code == 200
    assert guarded.get("/v1/scenes", headers={**BEARER, "Origin": "http://evil"}).status_code == 200


def test_the_token_is_asked_for_before_the_body_is_read(guarded: TestClient) -> None:
    large = b"x" * (8 << 20)
    assert guarded.post("/v1/scenes/hall/frame", content=large).status_code == 401


def test_without_a_token_foreign_pages_are_refused(backend: Any, tmp_path: Any) -> None:
    with make_client(backend, tmp_path) as client:
        assert client.get("/v1/scenes").status_code == 200
        assert client.get("/v1/scenes", headers={"Host": "127.0.0.1:8000"}).status_code == 200
        assert client.get("/v1/scenes", headers={"Host": "[::1]:8000"}).status_code == 200
        for host in ("evil.example", "localhost.evil.example", "127.0.0.1.evil.example", "", "a@b", "[", "192.168.0.9"):
            assert client.get("/v1/scenes", headers={"Host": host}).status_code == 403, host
        assert client.get("/healthz", headers={"Host": "10.0.0.1"}).status_code == 200
        for origin in ("http://evil.example", "null", "http://localhost:1", "http://["):
            assert client.post("/v1/bundles", headers={"Origin": origin}).status_code == 403, origin
        assert client.post("/v1/bundles", headers={"Origin": "http://localhost"}).status_code == 415


def test_open_to_all_on_purpose_takes_any_host(backend: Any, tmp_path: Any) -> None:
    with make_client(backend, tmp_path, "example.org", host="0.0.0.0", allow_unauthenticated=True) as client:
        assert client.get("/v1/scenes").status_code == 200
        assert client.post("/v1/bundles", headers={"Origin": "http://evil.example"}).status_code == 403


def test_bodies_over_the_limit_are_413(backend: Any, tmp_path: Any) -> None:
    with make_client(backend, tmp_path, body_max_nbytes=2048) as client:
        for content in (b"x" * 4096, iter([b"x" * 1024] * 4)):
            response = client.post("/v1/scenes/tabletop/frame", content=content)
            assert response.status_code == 413 and response.json()["status"] == 413, response.text
            assert "at most 2048 bytes" in response.json()["detail"]
        lying = client.post("/v1/scenes/tabletop/frame", content=b"{}", headers={"Content-Length": "9" * 30})
        assert lying.status_code == 413
        assert client.post("/v1/scenes/tabletop/frame", content=b"{}").status_code == 422
        assert backend.cameras == []


def test_a_service_that_others_reach_needs_a_token_or_a_flag() -> None:
    with pytest.raises(AccessError, match="LIGHTWELL_TOKEN, or give --allow-unauthenticated"):
        ServiceConfig(store_url="s", host="0.0.0.0").check_exposure()
    with pytest.raises(AccessError):
        ServiceConfig(store_url="s", host="example.org").check_exposure()
    assert "nothing asks" in (
        ServiceConfig(store_url="s", host="::", allow_unauthenticated=True).check_exposure() or ""
    )
    assert ServiceConfig(store_url="s", host="0.0.0.0", token=TOKEN).check_exposure() is None
    assert "guessed" in (ServiceConfig(store_url="s", token="short").check_exposure() or "")
    for host in ("127.0.0.1", "::1", "localhost"):
        assert ServiceConfig(store_url="s", host=host).check_exposure() is None


def test_environment_is_read_and_flags_win(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LIGHTWELL_TOKEN", TOKEN)
    monkeypatch.setenv("LIGHTWELL_PORT", "9000")
    monkeypatch.setenv("LIGHTWELL_UPLOAD_MAX_FILES", "7")
    config = load_config(store_url="s", port=None, host="::1")
    assert (config.port, config.host, config.upload_max_files) == (9000, "::1", 7)
    assert config.token is not None and config.token.get_secret_value() == TOKEN
    assert load_config(store_url="s", port=1).port == 1


@pytest.mark.parametrize(("name", "value"), [("TOKEN", ""), ("TOKEN", "a b"), ("TOKEN", "sécret"), ("PORT", "99999"),
                                             ("UPLOAD_MAX_RATIO", "0"), ("MAX_PIXELS", "many-secret")])  # fmt: skip
def test_bad_configuration_names_the_field_and_not_the_value(monkeypatch: Any, name: str, value: str) -> None:
    monkeypatch.setenv(f"LIGHTWELL_{name}", value)
    with pytest.raises(OptionError, match=name.lower()) as caught:
        load_config(store_url="s")
    assert len(value) < 4 or value not in str(caught.value)


def test_no_secret_is_shown_by_the_configuration() -> None:
    config = ServiceConfig(
        store_url="s3://key:pw1secret@host/b", token=TOKEN, database_url="postgresql://me:p%40ss@h/d"
    )
    for shown in (repr(config), str(config)):
        assert TOKEN not in shown and "pw1secret" not in shown and "p%40ss" not in shown
    assert set(config.secrets()) == {TOKEN, "pw1secret", "p%40ss", "p@ss"}


def test_bundles_lie_in_a_local_store_or_a_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert ServiceConfig(store_url="/a").bundles_path.as_posix() == "/a/bundles"
    assert ServiceConfig(store_url="file:///a").bundles_path.as_posix() == "/a/bundles"
    assert ServiceConfig(store_url="s3://b/c").bundles_path == tmp_path / "lightwell" / "bundles"
    assert ServiceConfig(store_url="s3://b/c", bundles_folder=tmp_path).bundles_path == tmp_path


def test_problems_hold_no_secret() -> None:
    register_secrets([TOKEN, "abc"])
    assert TOKEN.encode() not in problem(500, f"cannot reach https://{TOKEN}@host").body
    assert redact("abc") == "abc"  # too short to be cut out


def formatted(record: logging.LogRecord) -> str:
    assert RedactingFilter().filter(record)
    return logging.Formatter("%(message)s").format(record)


def test_logs_hold_no_secret() -> None:
    register_secrets([TOKEN])
    try:
        raise ValueError(f"bad {TOKEN}")
    except ValueError as error:
        exc_info = (type(error), error, error.__traceback__)
    for record in (
        logging.LogRecord("a", 20, "f", 1, f"token {TOKEN}", (), None),
        logging.LogRecord("a", 20, "f", 1, "token %s of %d", (TOKEN, 3), None),
        logging.LogRecord("a", 20, "f", 1, "token %s", ({"t": TOKEN},), None),
        logging.LogRecord("a", 20, "f", 1, "token %(t)s", ({"t": TOKEN},), None),
        logging.LogRecord("a", 40, "f", 1, "failed", (), exc_info),
    ):
        text = formatted(record)
        assert TOKEN not in text and "[secret]" in text


def test_a_real_server_logs_neither_token_nor_query(backend: Any, tmp_path: Any, capfd: Any) -> None:
    config = ServiceConfig(store_url=str(tmp_path / "store"), token=TOKEN)
    app = create_app(config.store_url, make_backend=lambda: backend, config=config)
    with bind("127.0.0.1", 0) as listener:
        server = uvicorn.Server(uvicorn.Config(app, log_level="info"))
        redact_logs()
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        deadline_s = time.monotonic() + 10
        while not server.started and time.monotonic() < deadline_s:
            time.sleep(0.01)
        url = f"http://127.0.0.1:{listener.getsockname()[1]}/v1/scenes"
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        assert opener.open(urllib.request.Request(url + "?page=unseen", headers=BEARER), timeout=10).status == 200
        for query in (f"?token={TOKEN}", f"/{TOKEN}"):
            with pytest.raises(urllib.error.HTTPError) as refused:
                opener.open(url + query, timeout=10)
            assert refused.value.code == 401 and TOKEN not in refused.value.read().decode()
            refused.value.close()
        server.should_exit = True
        thread.join(10)
    out, err = capfd.readouterr()
    assert "/v1/scenes HTTP/1.1" in out and "/v1/scenes/[secret]" in out
    assert TOKEN not in out + err and "unseen" not in out + err
