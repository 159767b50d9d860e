"""A run that another version made is told as such, and not as units that are missing."""

from pathlib import Path

import pytest

from storage.store import Store
from workers import code_versions
from workers.errors import VersionError
from workers.pipeline import evaluate_scene
from workers.progress import Progress
from workers.renderer import open_run, publish
from workers.run_state import RunState
from workers.scene import Scene, load_scene
from workers.settings import Settings


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene("tiny", width=16, height=16)


@pytest.fixture
def store(scene: Scene, tmp_path: Path) -> Store:
    """A store in which a run of the scene was published."""
    store = Store.open(tmp_path / "store", create=True)
    run = RunState(scene, store, Settings.preset_named("tiny").override({"width": 16, "height": 16}))
    publish(run, run.ref("train", {}), 30.0)
    return store


def test_run_of_this_version_opens(store: Store) -> None:
    entry = store.find_scene("tiny")
    assert entry["code_versions"] == code_versions.code_versions()
    assert open_run(store, entry, Progress())[1].key == entry["network"]


@pytest.mark.parametrize("name", ["ELEMENTS_VERSION", "FILTER_VERSION", "SCHEMA_VERSION"])
def test_run_of_another_version_is_told_with_both(
    store: Store, scene: Scene, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = getattr(code_versions, name)
    monkeypatch.setattr(code_versions, name, here + 1)
    what = name.partition("_")[0].lower()
    told = rf"made by another version \({what} {here}; this is {what} {here + 1}\); run again: lightwell run tiny"
    with pytest.raises(VersionError, match=told):
        open_run(store, store.find_scene("tiny"), Progress())
    with pytest.raises(VersionError, match=told):
        evaluate_scene(scene, store, Settings.preset_named("tiny"), Progress())


def test_run_from_before_versions_were_recorded_is_of_their_first(store: Store) -> None:
    entry = {key: value for key, value in store.find_scene("tiny").items() if key != "code_versions"}
    if code_versions.code_versions() == code_versions._UNRECORDED:
        code_versions.check_versions(entry, store.url)
    else:
        with pytest.raises(VersionError, match="another version"):
            code_versions.check_versions(entry, store.url)
