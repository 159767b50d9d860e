"""Hostile and malformed bundles through the HTTP service: each is refused with a reason and leaves nothing."""

import random
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from hypothesis import given, settings
from hypothesis import strategies as st

from service.app import create_app
from service.config import ServiceConfig
from tests.service import hostile_archives, hostile_assets, hostile_scenes
from tests.service.bundle_packing import Hostile, info_of, pack, pack_infos, xml

GROUPS = (
    hostile_archives.bad_names, hostile_archives.bad_entries, hostile_archives.bad_archives, hostile_scenes.bad_xml,
    hostile_scenes.bad_paths, hostile_scenes.bad_plugins, hostile_scenes.bad_numbers, hostile_scenes.bad_yaml,
    hostile_assets.bad_meshes, hostile_assets.bad_pictures,
)  # fmt: skip
HOSTILE = [hostile for group in GROUPS for hostile in group()]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    store = tmp_path_factory.mktemp("area") / "store"  # in a folder of its own, where escapes would be seen
    store.mkdir()
    return store


@pytest.fixture(scope="module")
def client(store: Path) -> Iterator[TestClient]:
    config = ServiceConfig(
        store_url=str(store), upload_max_files=256, upload_max_nbytes=4 << 20, upload_max_unpacked_nbytes=64 << 20
    )

    class NoScenes:
        def scenes(self) -> list[dict[str, Any]]:
            return []

    app = create_app(str(store), make_backend=NoScenes, config=config)  # type: ignore[arg-type, return-value]
    with TestClient(app, base_url="http://localhost") as client:
        yield client


def upload(client: TestClient, archive: bytes) -> Any:
    return client.post("/v1/bundles", content=archive, headers={"Content-Type": "application/zip"})


def left_behind(store: Path) -> list[Path]:
    return [path for path in store.parent.rglob("*") if path not in (store, store / "bundles")]


def assert_refused(response: Any, words: str) -> None:
    assert 400 <= response.status_code < 500, response.text
    assert response.headers["content-type"] == "application/problem+json"
    document = response.json()
    assert document["entry"] and document["rule"].startswith("must"), document
    assert re.search(words, document["detail"]), document["detail"]


def test_there_are_over_200_of_them_and_no_two_are_equal() -> None:
    labels = [hostile.label for hostile in HOSTILE]
    assert len({hostile.archive() for hostile in HOSTILE}) > 200
    assert len(HOSTILE) > 400 and len(set(labels)) == len(labels)


@pytest.mark.parametrize("hostile", HOSTILE, ids=lambda hostile: hostile.label)
def test_hostile_bundle_is_refused_and_leaves_nothing(client: TestClient, store: Path, hostile: Hostile) -> None:
    assert_refused(upload(client, hostile.archive()), hostile.words)
    assert left_behind(store) == []


def test_a_flipped_byte_is_refused_or_changes_nothing_that_counts(client: TestClient, store: Path) -> None:
    good = pack({"scene.xml": xml(""), "a.obj": b"v 0 0 0\n" * 20})
    random_state = random.Random(0)
    outcomes = set()
    for _ in range(200):
        damaged = bytearray(good)
        damaged[random_state.randrange(len(good))] ^= 1 << random_state.randrange(8)
        response = upload(client, bytes(damaged))
        outcomes.add(response.status_code)
        if response.status_code in (200, 201):
            assert response.json()["num_files"] in (1, 2)
            assert client.delete(f"/v1/bundles/{response.json()['id']}").status_code == 204
        else:
            assert_refused(response, ".")
        assert left_behind(store) == []
    assert 422 in outcomes and outcomes <= {200, 201, 413, 422}


texts = st.text(max_size=60)
fuzz = settings(max_examples=30, deadline=None, derandomize=True)


def assert_clean(client: TestClient, store: Path, archive: bytes) -> None:
    response = upload(client, archive)
    if response.status_code in (200, 201):
        for scene in response.json()["scenes"]:
            inside = (store / "bundles" / response.json()["id"] / response.json()["name"]).resolve()
            assert (inside / scene["file"]).resolve().is_relative_to(inside)
        assert client.delete(f"/v1/bundles/{response.json()['id']}").status_code == 204
    else:
        assert_refused(response, ".")
    assert left_behind(store) == []


@fuzz
@given(name=texts)
def test_any_entry_name_is_confined(client: TestClient, store: Path, name: str) -> None:
    try:
        archive = pack_infos((info_of(name), b"x"))
    except UnicodeEncodeError:  # lone surrogates cannot be packed
        return
    assert_clean(client, store, archive)


@fuzz
@given(content=st.binary(max_size=300))
def test_any_bytes_are_no_error_of_the_service(client: TestClient, store: Path, content: bytes) -> None:
    assert_clean(client, store, content)
    for name in ("scene.xml", "scene.yaml", "a.gltf", "a.glb", "a.obj", "a.ply"):
        assert_clean(client, store, pack({name: content}))


@fuzz
@given(
    tag=st.sampled_from(["shape", "bsdf", "texture", "include", "path", "string", "float", "default", "ref", "film"]),
    attributes=st.dictionaries(
        st.sampled_from(["type", "name", "value", "filename", "id", "as", "version"]),
        st.sampled_from(["bitmap", "filename", "../x", "$a", "1e9", "obj", "", "scene.xml", "hdrfilm"]),
    ),
)
def test_any_element_is_judged(client: TestClient, store: Path, tag: str, attributes: dict[str, str]) -> None:
    inner = " ".join(f'{key}="{value}"' for key, value in attributes.items())
    assert_clean(
        client, store, pack({"scene.xml": xml(f"<{tag} {inner}/><shape type='cube'><{tag} {inner}/></shape>")})
    )
