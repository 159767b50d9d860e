"""One suite that every store must pass; raw file access bypasses the code under test."""

import errno
import json
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fsspec
import pytest

from storage import layout
from storage.errors import (
    CanonicalError,
    DamagedUnitError,
    MissingUnitError,
    PathNameError,
    SceneNotFoundError,
    StoreNotFoundError,
    StoreVersionError,
    StoreWriteError,
)
from storage.keys import seed_from_key
from storage.store import Store, UnitRef
from storage.verification import find_problems, repair

DIGEST = "0123456789abcdef"
REF = UnitRef(DIGEST, "render", "ab" * 16)
FILES = {"frame.exr": b"pixels" * 100, "Bild ☕.json": b"{}", "empty": b""}


class StoreContract:
    """What a store promises, wherever it lies. A subclass gives `url`."""

    @pytest.fixture
    def url(self, tmp_path: Path) -> str:
        raise NotImplementedError

    @pytest.fixture
    def store(self, url: str) -> Store:
        store = Store.open(url, create=True)
        store.register_scene(DIGEST, {"name": "Küche ☕", "num_triangles": 12})
        return store

    def raw_path(self, store: Store, name: str) -> str:
        entry = {} if name == layout.MARKER else (store.committed(REF) or {"files": {}})["files"].get(name, {})
        return store.files.path(layout.stored_file(REF.folder, name, entry))

    def raw_get(self, store: Store, name: str) -> bytes:
        with store.files.filesystem.open(self.raw_path(store, name), "rb") as file:
            return file.read()

    def raw_set(self, store: Store, name: str, data: bytes) -> None:
        with store.files.filesystem.open(self.raw_path(store, name), "wb") as file:
            file.write(data)

    def test_open_refuses_a_missing_store(self, url: str) -> None:
        with pytest.raises(StoreNotFoundError, match="create=True") as caught:
            Store.open(url)
        assert isinstance(caught.value, FileNotFoundError)
        assert url in str(caught.value)

    def test_open_finds_what_was_created(self, store: Store, url: str) -> None:
        assert Store.open(url).scenes() == store.scenes()
        assert Store.open(url, create=True).scenes() == store.scenes()

    def test_open_refuses_another_layout(self, store: Store, url: str) -> None:
        store.files.write(layout.STORE_FILE, b'{"layout_version": 99}')
        with pytest.raises(StoreVersionError, match="got 99"):
            Store.open(url)

    def test_open_refuses_a_damaged_header(self, store: Store, url: str) -> None:
        store.files.write(layout.STORE_FILE, b'{"layout_ver')
        with pytest.raises(DamagedUnitError, match="must hold the JSON object"):
            Store.open(url)

    def test_store_survives_pickling(self, store: Store) -> None:
        store.commit(REF, FILES, {})
        assert pickle.loads(pickle.dumps(store)).read(REF, "frame.exr") == FILES["frame.exr"]

    def test_scenes_are_found_by_digest_name_and_prefix(self, store: Store) -> None:
        entry = {"digest": DIGEST, "name": "Küche ☕", "num_triangles": 12}
        assert store.scenes() == [entry]
        for handle in (DIGEST, "Küche ☕", DIGEST[:6]):
            assert store.find_scene(handle) == entry

    def test_a_damaged_entry_takes_no_other_scene_with_it(self, store: Store, caplog: pytest.LogCaptureFixture) -> None:
        store.register_scene("other", {"name": "hall"})
        store.files.write(layout.scene_file("other"), b'{"name": "ha')
        assert [entry["digest"] for entry in store.scenes()] == [DIGEST]
        assert layout.scene_file("other") in caplog.text and "lightwell verify" in caplog.text
        assert store.find_scene(DIGEST)["digest"] == DIGEST
        with pytest.raises(DamagedUnitError, match="must hold the JSON object"):
            store.find_scene("hall")
        assert any(layout.scene_file("other") in problem for problem in store.verify())

    def test_find_scene_names_the_known_ones(self, store: Store) -> None:
        with pytest.raises(SceneNotFoundError, match="Küche ☕"):
            store.find_scene("Bad")

    def test_find_scene_refuses_an_ambiguous_name(self, store: Store) -> None:
        store.register_scene("fedcba9876543210", {"name": "Küche ☕"})
        with pytest.raises(SceneNotFoundError, match="2 matches; tell them apart by digest"):
            store.find_scene("Küche ☕")

    def test_register_scene_again_updates_its_facts(self, store: Store) -> None:
        store.register_scene(DIGEST, {"num_triangles": 13})
        assert store.scenes() == [{"digest": DIGEST, "name": DIGEST, "num_triangles": 13}]

    def test_commit_round_trips_every_file(self, store: Store) -> None:
        store.commit(REF, FILES, {"seconds": 1.5})
        assert {name: store.read(REF, name) for name in FILES} == FILES
        assert store.units(DIGEST, "render") == [REF]
        assert store.verify() == []
        assert store.nbytes(REF) == sum(map(len, FILES.values())) + len(self.raw_get(store, "commit.json"))

    def test_commit_record_holds_the_contract(self, store: Store) -> None:
        record = store.commit(REF, FILES, {"params": {"spp": 4}, "versions": {"mitsuba": "3.9.1"}})
        assert record == store.committed(REF)
        assert (record["key"], record["stage"], record["params"]) == (REF.key, "render", {"spp": 4})
        assert record["seed"] == seed_from_key(REF.key)
        assert record["files"]["frame.exr"]["nbytes"] == 600
        assert record["versions"].keys() >= {"mitsuba", "python", "zarr"}
        assert record["created_unix_s"] > 1.7e9

    def test_seed_0_is_kept_and_none_means_not_given(self, store: Store) -> None:
        assert store.commit(REF, FILES, {"seed": 0})["seed"] == 0
        other = UnitRef(DIGEST, "render", "cd" * 16)
        assert store.commit(other, FILES, {"seed": None})["seed"] == seed_from_key(other.key)

    def test_commit_again_leaves_the_first(self, store: Store) -> None:
        first = store.commit(REF, FILES, {})
        assert store.commit(REF, {"frame.exr": b"other"}, {"note": "second"}) == first
        assert store.read(REF, "frame.exr") == FILES["frame.exr"]

    @pytest.mark.parametrize("record", [{"psnr": float("nan")}, {"key": "other"}, {"files": {}}])
    def test_commit_refuses_a_bad_record(self, store: Store, record: dict[str, Any]) -> None:
        with pytest.raises(CanonicalError, match=r"record.*must"):
            store.commit(REF, FILES, record)
        assert store.committed(REF) is None

    @pytest.mark.parametrize("name", ["../x", "a/b", "", ".hidden", "commit.json", "a\nb", "x" * 201, "a\\b"])
    def test_commit_refuses_names_that_are_no_segment(self, store: Store, name: str) -> None:
        with pytest.raises(PathNameError, match="file name must be"):
            store.commit(REF, {name: b""}, {})

    @pytest.mark.parametrize("ref", [UnitRef("..", "a", "b"), UnitRef("d", "a/b", "k"), UnitRef("d", "a", "")])
    def test_commit_refuses_an_address_that_leaves_the_store(self, store: Store, ref: UnitRef) -> None:
        with pytest.raises(PathNameError, match="must be 1 to 128"):
            store.commit(ref, FILES, {})

    def test_read_refuses_what_is_not_there(self, store: Store) -> None:
        with pytest.raises(MissingUnitError, match="run its stage first"):
            store.read(REF, "frame.exr")
        store.commit(REF, FILES, {})
        with pytest.raises(MissingUnitError, match=r"got 'frame\.png'"):
            store.read(REF, "frame.png")

    def test_read_finds_a_truncated_file(self, store: Store) -> None:
        store.commit(REF, FILES, {})
        self.raw_set(store, "frame.exr", FILES["frame.exr"][:-1])
        self.check_damage(store, "has 599 bytes instead of 600")

    def test_read_finds_a_flipped_bit(self, store: Store) -> None:
        store.commit(REF, FILES, {})
        self.raw_set(store, "frame.exr", b"q" + FILES["frame.exr"][1:])
        self.check_damage(store, "differs from its SHA-256")

    def test_read_finds_a_deleted_file(self, store: Store) -> None:
        store.commit(REF, FILES, {})
        store.files.filesystem.rm_file(self.raw_path(store, "frame.exr"))
        self.check_damage(store, "is missing")

    def check_damage(self, store: Store, problem: str) -> None:
        with pytest.raises(DamagedUnitError, match=problem) as caught:
            store.read(REF, "frame.exr")
        for part in (REF.key, store.url, self.raw_path(store, "frame.exr"), "verify --store"):
            assert part in str(caught.value)
        assert store.verify() == [str(caught.value)]
        store.discard(REF)
        store.commit(REF, FILES, {})
        assert store.verify() == []

    @pytest.mark.parametrize("damage", ["truncate", "edit", "foreign", "binary"])
    def test_damaged_marker_is_no_commit_and_no_absence(self, store: Store, damage: str) -> None:
        store.commit(REF, FILES, {"seconds": 1})
        marker = self.raw_get(store, "commit.json")
        foreign = UnitRef(DIGEST, "render", "cd" * 16)
        store.commit(foreign, FILES, {})
        changed = {
            "truncate": marker[:-9],
            "edit": marker.replace(b'"seconds": 1', b'"seconds": 2'),
            "foreign": store.files.read(layout.unit_marker(foreign.folder)),
            "binary": b"\xff\x00",
        }[damage]
        assert changed is not None and changed != marker
        self.raw_set(store, "commit.json", changed)
        with pytest.raises(DamagedUnitError, match=r"commit\.json"):
            store.committed(REF)
        assert len(store.verify()) == 1

    def test_missing_marker_means_not_committed(self, store: Store) -> None:
        store.commit(REF, FILES, {})
        store.files.filesystem.rm_file(self.raw_path(store, "commit.json"))
        assert store.committed(REF) is None
        assert store.units(DIGEST, "render") == []
        assert "has no commit marker" in store.verify()[0]
        store.commit(REF, {"frame.exr": b"again"}, {})
        assert store.read(REF, "frame.exr") == b"again"
        assert all("belongs to no commit" in text for text in store.verify())  # files of a commit without marker
        assert all([repair(store, problem) for problem in find_problems(store)])
        assert store.verify() == []

    def test_discard_forgets_the_unit(self, store: Store) -> None:
        store.commit(REF, FILES, {})
        store.discard(REF)
        store.discard(REF)
        assert store.committed(REF) is None
        assert store.nbytes(REF) == 0
        assert store.verify() == []

    def test_quarantine_stands_until_the_unit_is_committed(self, store: Store) -> None:
        assert store.quarantined() == []
        first = store.quarantine(REF, "7 pixels are NaN", facts={"nan": 7})
        assert (first["reason"], first["cause"], first["facts"]) == ("7 pixels are NaN", "health", {"nan": 7})
        assert (first["stage"], first["key"], first["unit"]) == (REF.stage, REF.key, None)
        again = store.quarantine(REF, "3 pixels are NaN")
        assert (first["attempts"], again["attempts"]) == (1, 2)
        assert store.committed(REF) is None
        assert store.units(DIGEST, "render") == []
        assert store.quarantined() == store.quarantined(DIGEST) == [again]
        assert store.quarantined("fedcba9876543210") == []
        assert store.verify() == []  # nothing is damaged
        store.commit(REF, FILES, {})
        assert store.quarantined() == []

    def test_units_of_an_unknown_stage_are_none(self, store: Store) -> None:
        assert store.units(DIGEST, "nothing") == []

    def test_verify_names_a_scene_without_entry(self, store: Store) -> None:
        store.files.remove(layout.scene_file(DIGEST))
        store.commit(REF, FILES, {})
        assert [problem for problem in store.verify() if "no registered scene" in problem]

    def test_files_of_others_are_ignored(self, store: Store) -> None:
        for place in ("scenes/.DS_Store", f"scenes/{DIGEST}/.DS_Store", f"scenes/{DIGEST}/render/.DS_Store"):
            store.files.write(place, b"x")
        store.commit(REF, FILES, {})
        assert (len(store.scenes()), store.units(DIGEST, "render"), store.verify()) == (1, [REF], [])


class TestS3Store(StoreContract):
    @pytest.fixture
    def url(self, s3_url: str) -> str:
        return f"{s3_url}/Läger [1] #2"


class TestMemoryStore(StoreContract):
    @pytest.fixture
    def url(self, tmp_path: Path) -> Iterator[str]:
        yield f"memory://{tmp_path.name}/store"
        fsspec.filesystem("memory").store.clear()

    def test_failed_commit_leaves_no_marker(self, store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
        put = store.files.filesystem.pipe_file

        def fail_late(path: str, data: bytes) -> None:
            if path.endswith("empty"):
                raise OSError(errno.ENOSPC, "no space left")
            put(path, data)

        monkeypatch.setattr(store.files.filesystem, "pipe_file", fail_late)
        with pytest.raises(StoreWriteError, match="no space left"):
            store.commit(REF, FILES, {})
        assert store.committed(REF) is None


class TestLocalStore(StoreContract):
    @pytest.fixture
    def url(self, tmp_path: Path) -> str:
        return str(tmp_path / "Läger [1] #2 *")

    def names(self, url: str) -> set[str]:
        return {path.name for path in Path(url).rglob("*")}

    def test_open_takes_a_path(self, tmp_path: Path) -> None:
        assert Store.open(tmp_path / "store", create=True).scenes() == []

    @pytest.mark.parametrize("call", ["fsync", "rename"])
    @pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "no space left"), KeyboardInterrupt()])
    def test_failed_commit_leaves_nothing(
        self, store: Store, url: str, monkeypatch: pytest.MonkeyPatch, call: str, error: BaseException
    ) -> None:
        before = self.names(url)

        def fail(*args: Any) -> None:
            raise error

        with monkeypatch.context() as patch:
            patch.setattr(os, call, fail)
            with pytest.raises((StoreWriteError, KeyboardInterrupt)):
                store.commit(REF, FILES, {})
        assert self.names(url) - before <= {"render"}
        assert store.committed(REF) is None
        store.commit(REF, FILES, {})
        assert store.verify() == []

    def test_failed_write_keeps_the_old_file(self, store: Store, url: str, monkeypatch: pytest.MonkeyPatch) -> None:
        def fail(*args: Any) -> None:
            raise OSError(errno.ENOSPC, "no space left")

        before = self.names(url)
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", fail)
            with pytest.raises(StoreWriteError, match="free space"):
                store.register_scene(DIGEST, {"name": "new"})
        assert self.names(url) == before
        assert store.find_scene(DIGEST)["name"] == "Küche ☕"

    def test_marker_is_the_last_file_synced_before_the_rename(
        self, store: Store, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        events: list[str] = []
        fsync, rename = os.fsync, os.rename

        def spy_fsync(descriptor: int) -> None:
            events.append(Path(os.readlink(f"/proc/self/fd/{descriptor}")).name)
            fsync(descriptor)

        def spy_rename(source: str, target: str) -> None:
            events.append("rename")
            rename(source, target)

        if not Path("/proc/self/fd").is_dir():
            pytest.skip("needs /proc to name descriptors")
        monkeypatch.setattr(os, "fsync", spy_fsync)
        monkeypatch.setattr(os, "rename", spy_rename)
        store.commit(REF, FILES, {})
        assert events[:4] == [*FILES, "commit.json"]
        assert events[4].endswith(".partial")  # the folder that holds them
        assert events[5:] == ["rename", "render"]

    def test_leftovers_of_a_killed_process_are_reported_and_ignored(self, store: Store, url: str) -> None:
        leftover = Path(url) / layout.partial_name(REF.folder)
        leftover.mkdir(parents=True)
        (leftover / "commit.json").write_bytes(b"{}")
        assert store.units(DIGEST, "render") == []
        assert "interrupted write" in store.verify()[0]

    def test_debris_without_marker_is_replaced_whole(self, store: Store, url: str) -> None:
        folder = Path(url) / REF.folder
        folder.mkdir(parents=True)
        (folder / "old.exr").write_bytes(b"old")
        store.commit(REF, FILES, {})
        assert {path.name for path in folder.iterdir()} == {*FILES, "commit.json"}

    def test_racing_commits_of_different_bytes_leave_one_whole_unit(self, url: str, store: Store) -> None:
        # Equal keys should mean equal bytes; even where a renderer breaks that, no unit may be mixed.
        for turn in range(10):
            ref = UnitRef(DIGEST, "render", f"{turn:032x}")
            start = threading.Barrier(4)
            records: list[dict[str, Any]] = []

            def work(index: int, ref: UnitRef = ref, start: threading.Barrier = start, records: Any = records) -> None:
                start.wait()
                files = {name: bytes([index]) * 50 for name in ("a", "b", "c")}
                records.append(Store.open(url).commit(ref, files, {"by": index}))

            threads = [threading.Thread(target=work, args=(index,)) for index in range(4)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            assert len({json.dumps(record, sort_keys=True) for record in records}) == 1
            assert len(records) == 4
        assert store.verify() == []

    def test_two_processes_commit_the_same_key(self, url: str, store: Store) -> None:
        code = (
            "import sys; from storage.store import Store, UnitRef\n"
            "store = Store.open(sys.argv[1])\n"
            "for i in range(50):\n"
            "    store.commit(UnitRef(sys.argv[2], 'render', f'{i:032x}'), {'a': b'x' * 999}, {})"
        )
        command = [sys.executable, "-c", code, url, DIGEST]
        root = str(Path(layout.__file__).parents[1])
        environment = {**os.environ, "PYTHONPATH": root}
        processes = [subprocess.Popen(command, env=environment) for _ in range(2)]
        assert [process.wait(timeout=60) for process in processes] == [0, 0]
        assert len(store.units(DIGEST, "render")) == 50
        assert store.verify() == []
