# ruff: noqa: E501  # tables are read by the row
"""Good bundles: what is found in them, what they are called, and how they are kept."""

import json
import re
import shutil
import zipfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.app import bundle_store, create_app
from service.bundle_assets import check_asset
from service.bundles import BundleStore, slug_of
from service.config import ServiceConfig
from service.errors import BundleStorageError, UnknownBundleError, UnknownSceneError
from service.routes_bundles import add_bundle_routes
from service.scene_sources import BUILTIN_NAMES, SceneSources
from storage.store import Store
from tests.service.bundle_packing import GLTF, PLY, TRIANGLE, YAML, glb, info_of, pack, pack_infos, png, xml
from tests.workers.plugin_scenes import write_plugin_scene

ZIP = {"Content-Type": "application/zip"}
TEXTURED = '<texture type="bitmap" id="t"><string name="filename" value="textures/a b.png"/></texture>'


@pytest.fixture
def config(tmp_path: Path) -> ServiceConfig:
    return ServiceConfig(store_url=str(tmp_path / "store"), upload_max_nbytes=1 << 20)


@pytest.fixture
def client(config: ServiceConfig, backend: Any) -> Iterator[TestClient]:
    app = create_app(config.store_url, make_backend=lambda: backend, config=config)
    with TestClient(app, base_url="http://localhost", raise_server_exceptions=False) as client:
        yield client


def accepted(client: TestClient, entries: dict[str, bytes], status: int = 201, **query: str) -> dict[str, Any]:
    response = client.post("/v1/bundles", content=pack(entries), headers=ZIP, params=query)
    assert response.status_code == status, response.text
    return response.json()


def scenes_of(bundle: dict[str, Any]) -> list[str]:
    return [scene["file"] for scene in bundle["scenes"]]


def test_an_uploaded_scene_can_be_named_listed_shown_and_deleted(client: TestClient, config: ServiceConfig) -> None:
    response = client.post(
        "/v1/bundles", files={"file": ("My Hall (v2).zip", pack({"scene.xml": xml(TEXTURED), "textures/a b.png": png(4, 4)}))}
    )  # fmt: skip
    assert response.status_code == 201, response.text
    bundle = response.json()
    assert bundle["name"] == "my-hall-v2" and bundle["num_files"] == 2 and bundle["notes"] == []
    assert response.headers["location"] == f"/v1/bundles/{bundle['id']}"
    assert bundle["scenes"] == [{"file": "scene.xml", "source": f"bundle:{bundle['id']}/scene.xml"}]
    assert client.get(response.headers["location"]).json() == bundle
    assert client.get("/v1/bundles").json() == {"bundles": [bundle]}
    sources = SceneSources(bundle_store(config))
    path = Path(sources.resolve_scene_source(bundle["source"]))
    assert path.read_bytes() == xml(TEXTURED) and path.parent.name == "my-hall-v2"
    assert sources.resolve_scene_source(bundle["scenes"][0]["source"]) == str(path)
    assert client.delete(response.headers["location"]).status_code == 204
    assert not path.exists() and list(config.bundles_path.iterdir()) == []
    assert client.get(response.headers["location"]).status_code == 404
    assert client.delete(response.headers["location"]).status_code == 404


def test_the_same_bundle_twice_is_one_and_another_name_another(client: TestClient) -> None:
    entries = {"scene.xml": xml("")}
    first = accepted(client, entries, name="hall")
    assert accepted(client, entries, status=200, name="hall") == first
    assert accepted(client, entries, name="attic")["id"] != first["id"]
    assert accepted(client, {"scene.xml": xml(" ")}, name="hall")["id"] != first["id"]
    assert [bundle["name"] for bundle in client.get("/v1/bundles").json()["bundles"]] == ["hall", "attic", "hall"]


@pytest.mark.parametrize(
    "entries",
    [
        {"scene.yaml": YAML.encode()},
        {"scene.yaml": b"defaults: &d {type: diffuse}\n".replace(b"defaults", b"settings") + YAML.encode()},
        {"a.obj": b"mtllib a.mtl\n" + TRIANGLE, "a.mtl": b"newmtl m\nmap_Kd tex tures/a.png\nbump -bm 1 missing.png\n"},
        {"a.gltf": json.dumps(GLTF).encode()},
        {"m/a.gltf": json.dumps({**GLTF, "images": [{"uri": "t/a%20b.png"}]}).encode(), "m/t/a%20b.png": png(1, 1)},
        {"a.glb": glb(json.dumps({"asset": {"version": "2.0"}, "nodes": [{"children": [1]}, {}]}).encode())},
        {"a.ply": PLY},
        {"a.stl": b"solid a\nendsolid a\n"},
        {"scene.xml": b"\xef\xbb\xbf" + xml("")},
        {"scene.xml": b'<?xml version="1.0" encoding="utf-8"?>\n<!-- a comment -->' + xml("")},
        {"scene/scene.xml": xml('<shape type="obj"><string name="filename" value="../models/a.obj"/></shape>'),
         "models/a.obj": TRIANGLE},
        {"scene.xml": xml('<include filename="parts/a.xml"/>'),
         "parts/a.xml": b'<scene version="3.0.0"><shape type="obj"><string name="filename" value="models/a.obj"/></shape></scene>',
         "models/a.obj": TRIANGLE},
        {"scene.xml": xml('<default name="light" value="d65"/><include filename="parts/render.xml"/>'),
         "parts/render.xml": b'<scene version="3.0.0"><include filename="lights/$light.xml"/></scene>',
         "lights/d65.xml": b'<spectrum version="3.0.0" type="d65"/>'},
        {"scene.xml": xml('<path value="spectra"/><bsdf type="diffuse"><spectrum name="reflectance" filename="a.spd"/></bsdf>'),
         "spectra/a.spd": b"400 0.5\n700 0.5\n"},
        {"scene.xml": xml('<default name="w" value="8"/><default name="width" value="16"/><sampler type="independent">'
                          '<integer name="sample_count" value="$width"/></sampler>')},
        {"scene.xml": xml('<integrator type="path"><integer name="maxDepth" value="-1"/></integrator>', "0.6.0")},
        {"scene.xml": xml('<bsdf type="diffuse" id="a/b"/><shape type="cube"><ref id="a/b"/></shape>')},
        {"scene.xml": xml('<shape type="cube"><transform name="to_world"><scale value="2"/><rotate y="1" angle="-9.5e+1"/>'
                          '<lookat origin="0, 0, 1" target="0 0 0" up="0,1,0"/></transform></shape>')},
        {"scene.xml": xml('<bsdf type="roughconductor"><string name="material" value="Cu_palik"/></bsdf>')},
        {"Ünï çødé/scene.xml": xml(""), "日本語.txt": b"", "Ünï çødé/a.PNG": b""},
    ],
)  # fmt: skip
def test_good_bundles_are_accepted(client: TestClient, entries: dict[str, bytes]) -> None:
    bundle = accepted(client, entries)
    assert scenes_of(bundle)[0] in entries and bundle["num_files"] == len(entries) and bundle["notes"] == []


def test_the_scene_near_the_root_comes_first(client: TestClient) -> None:
    names = ["a/scene.xml", "scene.xml", "other.xml", "b.yaml"]
    bundle = accepted(client, {name: YAML.encode() if name.endswith("yaml") else xml("") for name in names})
    assert scenes_of(bundle) == ["scene.xml", "b.yaml", "other.xml", "a/scene.xml"]


def test_meshes_are_scenes_only_where_nothing_else_is(client: TestClient) -> None:
    assert scenes_of(accepted(client, {"scene.xml": xml(""), "a.obj": TRIANGLE})) == ["scene.xml"]
    assert scenes_of(accepted(client, {"b.ply": PLY, "a.obj": TRIANGLE})) == ["a.obj", "b.ply"]


def test_files_of_other_programs_are_left_out_with_a_note(client: TestClient) -> None:
    bundle = accepted(client, {
        "scene.xml": xml(""), "old.xml": xml('<shape type="heightfield"/>', "0.6.0"), "build.xml": b"<project/>",
        "ci.yml": b"jobs: {}", "__MACOSX/scene.xml": b"?", ".git/config": b"", "meshes.zip": pack({"a": b""}),
    })  # fmt: skip
    assert scenes_of(bundle) == ["scene.xml"] and bundle["num_files"] == 4
    notes = "\n".join(bundle["notes"])
    for words in (
        "old.xml.*heightfield",
        "build.xml.*<project>",
        "ci.yml",
        "__MACOSX",
        ".git/config",
        "meshes.zip.*archives",
    ):
        assert re.search(words, notes), (words, notes)


def test_included_files_are_no_scenes_of_their_own(client: TestClient) -> None:
    part = b'<scene version="3.0.0"><shape type="cube"/></scene>'
    bundle = accepted(client, {"main.xml": xml('<include filename="part.xml"/>'), "part.xml": part})
    assert scenes_of(bundle) == ["main.xml"] and bundle["notes"] == []


def test_folder_entries_and_empty_folders_are_no_files(client: TestClient, config: ServiceConfig) -> None:
    folder = info_of("a/", external_attr=(0o040755 << 16) | 0x10)
    response = client.post("/v1/bundles", content=pack_infos((folder, b""), (info_of("a/b.txt"), b"x")), headers=ZIP)
    assert response.status_code == 201 and response.json()["num_files"] == 2


def test_unpacked_files_are_plain(client: TestClient, config: ServiceConfig) -> None:
    program = info_of("run.sh", external_attr=0o104777 << 16)
    bundle = client.post("/v1/bundles", content=pack_infos((program, b"#!/bin/sh\n")), headers=ZIP).json()
    path = config.bundles_path / bundle["id"] / bundle["name"] / "run.sh"
    assert path.stat().st_mode & 0o7111 == 0


def test_uploads_over_the_limit_are_413_however_they_come(client: TestClient, config: ServiceConfig) -> None:
    large = bytes(config.upload_max_nbytes + (100 << 10))

    def parts() -> Iterator[bytes]:
        yield from (large[start : start + 65536] for start in range(0, len(large), 65536))

    for response in (
        client.post("/v1/bundles", content=large, headers=ZIP),
        client.post("/v1/bundles", content=parts(), headers=ZIP),  # chunked, no length
        client.post("/v1/bundles", files={"file": ("a.zip", large)}),
        client.post("/v1/bundles", content=large[: config.upload_max_nbytes + 9], headers=ZIP),
        client.post("/v1/bundles", files={"file": ("a.zip", large[: config.upload_max_nbytes + 9])}),
    ):
        assert response.status_code == 413, response.text
        assert response.headers["content-type"] == "application/problem+json"
        assert list(config.bundles_path.glob("*")) == []


@pytest.mark.parametrize(
    ("headers", "content", "status"),
    [
        ({"Content-Type": "text/plain"}, b"x", 415),
        ({}, b"x", 415),
        ({"Content-Type": "multipart/form-data"}, b"x", 400),
        ({"Content-Type": "multipart/form-data; boundary=a"}, b"x", 400),
        ({"Content-Type": "multipart/form-data; boundary=a"}, b'--a\r\nContent-Disposition: form-data; name="b"\r\n\r\n1\r\n--a--', 415),
        ({"Content-Type": "application/zip"}, b"", 422),
    ],
)  # fmt: skip
def test_other_uploads_are_refused(
    client: TestClient, config: ServiceConfig, headers: dict[str, str], content: bytes, status: int
) -> None:
    response = client.post("/v1/bundles", content=content, headers=headers)
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    assert list(config.bundles_path.glob("*")) == []


@pytest.mark.parametrize("bundle_id", ["x", "..", "%2e%2e", "0" * 32, "0" * 31 + "/", "A" * 32, "bundle.json"])
def test_unknown_bundles_are_404(client: TestClient, bundle_id: str) -> None:
    assert client.get(f"/v1/bundles/{bundle_id}").status_code in (404, 307, 405)
    assert client.delete(f"/v1/bundles/{bundle_id}").status_code in (404, 307, 405)


def test_a_bundle_in_use_is_not_deleted(tmp_path: Path, config: ServiceConfig) -> None:
    from fastapi import FastAPI

    from service.problems import add_problem_handlers

    app = FastAPI()
    add_problem_handlers(app)
    add_bundle_routes(app, bundle_store(config), 1 << 20, in_use=lambda bundle_id: True)
    client = TestClient(app)
    bundle = accepted(client, {"scene.xml": xml("")})
    assert client.delete(f"/v1/bundles/{bundle['id']}").status_code == 409
    assert client.get(f"/v1/bundles/{bundle['id']}").status_code == 200


def test_a_bundle_whose_scene_is_served_is_not_deleted(client: TestClient, config: ServiceConfig) -> None:
    bundle = accepted(client, {"scene.xml": xml("")})
    store = Store.open(config.store_url, create=True)
    store.register_scene("d1", {"name": "hall", "source": str(config.bundles_path / bundle["id"] / "scene.xml")})
    assert client.delete(f"/v1/bundles/{bundle['id']}").status_code == 409
    store.register_scene("d1", {"name": "hall", "source": "/elsewhere/scene.xml"})
    assert client.delete(f"/v1/bundles/{bundle['id']}").status_code == 204


def test_a_served_bundle_of_a_store_given_by_a_relative_path_is_not_deleted(
    tmp_path: Path, backend: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    config = ServiceConfig(store_url="store")
    app = create_app(config.store_url, make_backend=lambda: backend, config=config)
    with TestClient(app, base_url="http://localhost") as client:
        bundle = accepted(client, {"scene.xml": xml("")})
        source = (config.bundles_path / bundle["id"] / "scene.xml").resolve()
        Store.open(config.store_url, create=True).register_scene("d1", {"name": "hall", "source": str(source)})
        assert client.delete(f"/v1/bundles/{bundle['id']}").status_code == 409


def test_what_a_crash_left_is_swept_and_what_is_being_received_is_not(config: ServiceConfig) -> None:
    store = bundle_store(config)
    with store.receiving() as incoming:
        (incoming / "upload.zip").write_bytes(b"half")
        left = config.bundles_path / ".incoming-crashed"
        left.mkdir()
        (left / "upload.zip").write_bytes(b"half")
        bundle_store(config)
        assert incoming.is_dir() and not left.exists()
    assert list(config.bundles_path.iterdir()) == []


def test_two_uploads_of_one_bundle_at_once_are_one_bundle(config: ServiceConfig, tmp_path: Path) -> None:
    store = bundle_store(config)

    def add(index: int) -> tuple[str, bool]:
        with store.receiving() as incoming:
            archive = incoming / "upload.zip"
            archive.write_bytes(pack({"scene.xml": xml("")}))
            bundle, is_new = store.add(incoming, archive, "hall")
            return bundle.id, is_new

    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(add, range(12)))
    assert len({bundle_id for bundle_id, _ in results}) == 1
    assert sum(is_new for _, is_new in results) == 1
    assert [path.name for path in config.bundles_path.iterdir()] == [results[0][0]]


def test_a_disk_that_refuses_is_507(client: TestClient, config: ServiceConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device", "/secret/path")

    monkeypatch.setattr("service.bundles.unpack", full)
    response = client.post("/v1/bundles", content=pack({"scene.xml": xml("")}), headers=ZIP)
    assert response.status_code == 507 and "No space left" in response.text and "secret" not in response.text
    assert list(config.bundles_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_a_storage_error(tmp_path: Path, config: ServiceConfig) -> None:
    (tmp_path / "file").write_text("")
    store = bundle_store(config)
    blocked = BundleStore(tmp_path / "file" / "bundles", store.archive_limits, store.scene_limits)
    with pytest.raises(BundleStorageError, match="Not a directory"), blocked.receiving():
        pass


def test_a_damaged_record_is_no_bundle(client: TestClient, config: ServiceConfig) -> None:
    bundle = accepted(client, {"scene.xml": xml("")})
    (config.bundles_path / bundle["id"] / "bundle.json").write_text("{")
    assert client.get(f"/v1/bundles/{bundle['id']}").status_code == 404
    assert client.get("/v1/bundles").json() == {"bundles": []}


@pytest.mark.parametrize(
    ("name", "slug"),
    [("hall.zip", "hall"), ("../../Ünï.ZIP", "n"), ("C:\\x\\My Scene.zip", "my-scene"), ("", "bundle"), ("é", "bundle"),
     ("a" * 99, "a" * 64), ("..", "bundle")],
)  # fmt: skip
def test_slug_of(name: str, slug: str) -> None:
    assert slug_of(name) == slug


def test_scene_sources_resolve_builtins_folder_and_bundles(tmp_path: Path, config: ServiceConfig) -> None:
    folder = tmp_path / "scenes"
    (folder / "hall").mkdir(parents=True)
    (folder / "hall" / "scene.xml").write_text("x")
    (folder / "lamp.glb").write_text("x")
    (folder / "notes.txt").write_text("x")
    (folder / "loop").symlink_to(folder / "loop")
    (tmp_path / "secret.xml").write_text("x")
    (folder / "link.xml").symlink_to(tmp_path / "secret.xml")
    (folder / "inner.xml").symlink_to(folder / "hall" / "scene.xml")
    sources = SceneSources(bundle_store(config), folder)
    assert sources.names() == ["tabletop", "tiny", "hall", "inner.xml", "lamp.glb"]
    assert sources.resolve_scene_source("tiny") == "tiny"
    assert sources.resolve_scene_source("builtin:tabletop") == "tabletop"
    assert sources.resolve_scene_source("hall") == str((folder / "hall" / "scene.xml").resolve())
    assert sources.resolve_scene_source("hall/scene.xml") == str((folder / "hall" / "scene.xml").resolve())
    for name in ("../secret.xml", "link.xml", "loop", "/etc/passwd", "notes.txt", "", ".", "hall/../../secret.xml",
                 "x\x00y", "no", "a" * 5000, "hall/scene.xml/x", str(tmp_path / "secret.xml"), "\ud800"):  # fmt: skip
        with pytest.raises(UnknownSceneError):
            sources.resolve_scene_source(name)
    for name in ("bundle:", "bundle:..", "bundle:" + "0" * 32, "bundle:../../x"):
        with pytest.raises(UnknownBundleError):
            sources.resolve_scene_source(name)


def test_a_bundle_answers_only_for_its_scenes(client: TestClient, config: ServiceConfig) -> None:
    bundle = accepted(client, {"scene.xml": xml(""), "a.txt": b"x"})
    sources = SceneSources(bundle_store(config))
    for scene in ("a.txt", "../bundle.json", "../../x", "/etc/passwd", "no.xml"):
        with pytest.raises(UnknownBundleError, match="scene must be one of bundle"):
            sources.resolve_scene_source(f"bundle:{bundle['id']}/{scene}")


def test_without_uploads_bundle_names_are_unknown_scenes() -> None:
    with pytest.raises(UnknownSceneError):
        SceneSources().resolve_scene_source("bundle:" + "0" * 32)


def test_builtin_names_are_those_of_the_loader() -> None:
    from workers.builtin_scenes import BUILTIN_SCENES

    assert set(BUILTIN_NAMES) == set(BUILTIN_SCENES)


def test_every_scene_suffix_is_one_of_the_loader() -> None:
    from service.bundle_scenes import MESH_SUFFIXES, YAML_SUFFIXES
    from workers import scene_mesh, scene_yaml

    assert MESH_SUFFIXES == scene_mesh.MESH_SUFFIXES and YAML_SUFFIXES == scene_yaml.YAML_SUFFIXES


@pytest.mark.parametrize("name", ["xml", "yaml", "obj"])
def test_the_loader_builds_what_is_accepted(config: ServiceConfig, tmp_path: Path, name: str) -> None:
    from workers.scene import load_scene

    yaml = "scene:\n  s: {type: perspective}\n  a: {type: sphere}\n  light: {type: constant}\n"
    files = {"xml": {"scene.xml": xml("")}, "yaml": {"scene.yaml": yaml.encode()}, "obj": {"a.obj": TRIANGLE}}[name]
    store = bundle_store(config)
    with store.receiving() as incoming:
        archive = incoming / "upload.zip"
        with zipfile.ZipFile(archive, "w") as packed:
            for file, content in files.items():
                packed.writestr(file, content)
        bundle, _ = store.add(incoming, archive, "hall.zip")
    scene = load_scene(store.scene_file(bundle.id), width=8, height=8)
    assert scene.name == ("a" if name == "obj" else "hall")
    shutil.rmtree(config.bundles_path)


@pytest.mark.parametrize(
    ("plugin", "file"),
    [("measured", "material.bsdf"), ("serialized", "mesh.serialized"), ("ply", "mesh.ply"), ("gridvolume", "six.vol"),
     ("ellipsoidsmesh", "ellipsoid.ply"), ("envmap", "sky.exr"), ("bitmap", "picture.png")],
)  # fmt: skip
def test_files_that_mitsuba_reads_are_accepted(tmp_path: Path, plugin: str, file: str) -> None:
    write_plugin_scene(tmp_path, "bsdf", "measured")
    check_asset(plugin, tmp_path / file, "here")
