"""`lightwell verify`: what it lists, what it repairs, and its exit codes."""

from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from service.cli import app
from storage.store import Store
from tests.storage import sample_store


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return sample_store.make(str(tmp_path / "store"))


def verify(url: str, *options: str) -> Result:
    return CliRunner().invoke(app, ["verify", "--store", url, *options])


def flip(store: Store, kind: str) -> Path:
    path = Path(store.files.path(sample_store.places(store)[kind]))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)
    return path


def test_whole_store_exits_0(store: Store) -> None:
    result = verify(store.url)
    assert (result.exit_code, result.stderr) == (0, "")
    assert "every file is what its marker promises" in result.stdout


def test_damage_is_listed_and_exits_1_and_changes_nothing(store: Store) -> None:
    path = flip(store, "frame")
    before = path.read_bytes()
    for _ in range(2):
        result = verify(store.url)
        assert result.exit_code == 1
        assert str(path) in result.stdout and "differs from its SHA-256" in result.stdout
        assert "1 to put right; run: lightwell verify" in result.stdout
    assert path.read_bytes() == before


@pytest.mark.parametrize("kind", ["frame", "chunk", "zarr array", "scene.json", "store.json", "weights"])
def test_repair_discards_what_is_damaged_and_the_next_run_makes_it_again(store: Store, kind: str) -> None:
    before = sample_store.content(store)
    flip(store, kind)
    assert verify(store.url).exit_code == 1
    repaired = verify(store.url, "--repair")
    assert (repaired.exit_code, repaired.stderr) == (0, "")
    assert "1 repaired" in repaired.stdout
    assert ("set aside, 1x (damage)" in repaired.stdout) == (kind not in ("scene.json", "store.json"))
    assert sample_store.content(sample_store.make(store.url)) == before
    assert verify(store.url).exit_code == 0


def test_header_that_is_lost_is_restored(store: Store) -> None:
    Path(store.url, "store.json").unlink()
    assert verify(store.url).exit_code == 1
    assert verify(store.url, "--repair").exit_code == 0
    assert sample_store.answers(Store.open(store.url)) == sample_store.expected()


def test_scene_without_entry_needs_a_run(store: Store) -> None:
    Path(store.files.path(sample_store.places(store)["scene.json"])).unlink()
    result = verify(store.url, "--repair")
    assert result.exit_code == 1
    assert "run the scene again" in result.stdout


def test_units_that_were_set_aside_are_told_and_are_no_damage(store: Store) -> None:
    store.discard(sample_store.ref_of("render"))
    store.quarantine(sample_store.ref_of("render"), "9 of 9 pixels NaN")
    result = verify(store.url)
    assert result.exit_code == 0
    assert "set aside, 1x (health): render/" in result.stdout and "9 of 9 pixels NaN" in result.stdout


@pytest.mark.parametrize("url", ["nothing-here", "s3://", "nothing://x"])
def test_no_store_is_one_line_and_exits_2(url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = verify(url)
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith("lightwell: ") and result.stderr.count("\n") == 1
