"""Damage at rest, full disks, denied access and death at any moment: found, told by name, redone; never served."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fsspec
import pytest

from storage import layout, markers
from storage.errors import DamagedUnitError, StorageError, StoreAccessError, StoreNotFoundError, StoreWriteError
from storage.store import Store
from storage.verification import find_problems, repair
from tests.storage import sample_store

ROOT = Path(__file__).parents[2]
KINDS = [
    "store.json", "scene.json", "marker", "frame", "weights", "weights' JSON", "checkpoint", "chunk", "last chunk",
    "bake unit's marker", "cache set's marker", "zarr group", "zarr array",
]  # fmt: skip
DAMAGES: dict[str, Callable[[bytes], bytes | None]] = {
    "truncate": lambda data: data[: len(data) // 2],
    "empty": lambda data: b"",
    "flip": lambda data: data[: len(data) // 2] + bytes([data[len(data) // 2] ^ 1]) + data[len(data) // 2 + 1 :],
    "delete": lambda data: None,
}
# A missing marker says "not committed"; the set's own is only a summary of its units' markers.
ABSENCE = {("marker", "delete"), ("cache set's marker", "delete")}


@pytest.fixture(scope="module")
def whole_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A local store that tests copy: making one takes a flush a file."""
    return Path(sample_store.make(str(tmp_path_factory.mktemp("whole") / "store")).url)


@pytest.fixture(params=["local", "memory", pytest.param("s3", marks=pytest.mark.slow)])
def url(request: pytest.FixtureRequest, tmp_path: Path, whole_store: Path) -> Iterator[str]:
    if request.param == "local":
        yield str(shutil.copytree(whole_store, tmp_path / "store"))
    elif request.param == "memory":
        yield f"memory://{tmp_path.name}/store"
    else:
        yield request.getfixturevalue("s3_url")
    fsspec.filesystem("memory").store.clear()


def damage(store: Store, path: str, kind: str) -> None:
    """Goes past the store's own code."""
    files, full = store.files.filesystem, store.files.path(path)
    changed = DAMAGES[kind](files.cat_file(full))
    files.rm_file(full)
    if changed is not None:
        files.pipe_file(full, changed)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("how", DAMAGES)
def test_damage_is_found_named_repaired_and_redone(url: str, kind: str, how: str) -> None:
    store = sample_store.make(url)
    before, path = sample_store.content(store), sample_store.places(store)[kind]
    damage(store, path, how)
    told = refusals(store)
    problems = list(find_problems(store)) if kind != "store.json" else []
    if (kind, how) not in ABSENCE and kind != "store.json":
        assert store.files.path(path) in " ".join([*told, *(problem.text for problem in problems)])
        assert problems
    if kind == "store.json":
        with pytest.raises((DamagedUnitError, StoreNotFoundError), match=r"store\.json"):
            Store.open(url)
        store.write_header()
    for problem in problems:
        if repair(store, problem) and problem.ref is not None:
            assert problem.text in [record["reason"] for record in store.quarantined()]
    redone = sample_store.make(url)
    assert sample_store.answers(redone) == sample_store.expected()
    assert sample_store.content(redone) == before
    assert redone.verify() == []
    assert redone.quarantined() == []  # what was set aside is committed again


def refusals(store: Store) -> list[str]:
    """Asks everything; nothing that is answered may be wrong. Returns what was said instead of an answer."""
    told, truth = [], sample_store.expected()
    for name, ask in sample_store.reads(store).items():
        try:
            assert ask() == truth[name], name
        except StorageError as error:
            told.append(str(error))
    return told


def test_sample_store_holds_every_kind(tmp_path: Path) -> None:
    store = sample_store.make(str(tmp_path / "store"))
    places = sample_store.places(store)
    assert list(places) == KINDS
    assert all(store.files.read(path) for path in places.values())
    assert sample_store.answers(store) == sample_store.expected()


def test_every_flipped_bit_of_a_marker_is_found_or_means_the_same(tmp_path: Path) -> None:
    store = sample_store.make(str(tmp_path / "store"))
    for kind in ("marker", "scene.json", "store.json"):
        data = store.files.read(sample_store.places(store)[kind]) or b""
        fields, found = markers.unseal(data), 0
        for bit in range(8 * len(data)):
            flipped = bytearray(data)
            flipped[bit // 8] ^= 1 << bit % 8
            try:
                assert markers.unseal(bytes(flipped)) == fields
            except ValueError:
                found += 1
        assert found > 7.9 * len(data)  # the rest: an E for an e, a letter's case in an escape


def test_unreadable_quarantine_record_is_named_and_removed(tmp_path: Path) -> None:
    store = sample_store.make(str(tmp_path / "store"))
    store.quarantine(sample_store.BAKE, "too bright", unit=1)
    damage(store, layout.quarantine_file(sample_store.BAKE, 1), "flip")
    (problem,) = find_problems(store)
    assert "no readable quarantine record" in problem.text
    assert repair(store, problem)
    assert store.verify() == []


# ------------------------------------------------------- faults while writing


def drive(mode: str, folder: Path, step: int) -> list[dict[str, Any]]:
    """Runs the driver; one dictionary a point."""
    command = [sys.executable, "-W", "error", "-m", "tests.storage.fault_driver", mode, str(folder), str(step)]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
    assert ran.returncode == 0, ran.stderr
    return [json.loads(line) for line in ran.stdout.splitlines()]


def check_points(points: list[dict[str, Any]], faulty_codes: set[int]) -> None:
    """Every point but the last went wrong as asked; afterwards all is as if nothing had happened."""
    assert len(points) >= 4
    assert {point["code"] for point in points[:-1]} == faulty_codes
    assert points[-1]["code"] == 0
    for point in points:
        assert point["after"] == 0, point
        assert (point["seen"]["wrong"], point["seen"]["left"]) == ([], []), point
        assert point["seen"]["content"] == points[-1]["seen"]["content"], point


STEPS = [pytest.param(1, marks=pytest.mark.slow), 17]  # every point, and a few of them


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("mode", ["crash", "torn"])
def test_death_at_any_change_of_the_disk_resumes_to_identical_bytes(tmp_path: Path, mode: str, step: int) -> None:
    points = drive(mode, tmp_path, step)
    check_points(points, {137})
    damaged = [text for point in points for text in point["seen"]["found"] if "must hold" in text]
    assert damaged == []  # a torn file has no marker that speaks for it


@pytest.mark.parametrize("step", STEPS)
def test_full_disk_at_any_change_is_refused_and_leaves_nothing_half_written(tmp_path: Path, step: int) -> None:
    points = drive("full", tmp_path, step)
    check_points(points, {3})
    for point in points[:-1]:
        assert "must be writable" in point["told"] and "free space" in point["told"]
        # zarr writes two metadata files at once; the child may end before the second one's thread has tidied up.
        expected = ("no commit marker", "caches.zarr")
        assert [text for text in point["seen"]["found"] if not any(part in text for part in expected)] == []


@pytest.mark.parametrize("step", [pytest.param(1, marks=pytest.mark.slow), 4])
def test_limit_on_the_size_of_files_is_refused(tmp_path: Path, step: int) -> None:
    points = drive("fsize", tmp_path, step)
    check_points(points, {3})
    assert all("must be writable" in point["told"] for point in points[:-1])


def test_small_disk_fills_up_and_is_refused_until_there_is_space(tmp_path: Path) -> None:
    disk, url = tmp_path / "disk", str(tmp_path / "disk" / "store")
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(disk)]
    try:
        subprocess.run(mount, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"cannot mount a tmpfs here: {error}")
    try:
        refused = 0
        for free_kib in range(0, 400, 8):
            ballast = disk / "ballast"
            used_kib = sum(path.stat().st_blocks for path in disk.rglob("store/**/*") if path.is_file()) // 2
            ballast.write_bytes(bytes(1024 * max(0, 1024 - used_kib - free_kib)))
            try:
                sample_store.make(url)
            except StoreWriteError as error:
                refused += 1
                assert "No space left" in str(error)
                assert not [path for path in disk.rglob("*.partial")]
                if Path(url, "store.json").exists():
                    refusals(Store.open(url))
            ballast.unlink()
        assert refused >= 5
        store = sample_store.make(url)
        assert sample_store.answers(store) == sample_store.expected()
        assert store.verify() == []
    finally:
        subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.parametrize("backend", ["memory", pytest.param("s3", marks=pytest.mark.slow)])
def test_refused_put_at_any_position_is_told_and_redone(
    backend: str, tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = f"memory://{tmp_path.name}" if backend == "memory" else request.getfixturevalue("s3_url")
    kind = fsspec.get_filesystem_class(base.partition(":")[0])
    name = "pipe_file" if backend == "memory" else "_call_s3"
    call, count, allowed = getattr(kind, name), 0, 0

    def check() -> None:
        nonlocal count
        count += 1
        if count > allowed:
            raise OSError(28, "No space left on device")

    def put(self: Any, *args: Any, **kwargs: Any) -> Any:
        check()
        return call(self, *args, **kwargs)

    async def request(self: Any, method: str, *args: Any, **kwargs: Any) -> Any:
        if method == "put_object":
            check()
        return await call(self, method, *args, **kwargs)

    contents = []
    for allowed in range(200):
        url, count = f"{base}/{allowed}", 0
        with monkeypatch.context() as patch:
            patch.setattr(kind, name, put if backend == "memory" else request)
            try:
                sample_store.make(url)
                break
            except StoreWriteError as error:
                assert "No space left" in str(error)
        if allowed:  # else there is not even a store.json
            assert refusals(Store.open(url))
        store = sample_store.make(url)
        assert sample_store.answers(store) == sample_store.expected()
        contents.append(sample_store.content(store))
    assert len(contents) > 15
    assert all(content == contents[0] for content in contents)
    fsspec.filesystem("memory").store.clear()


def test_denied_writes_are_told() -> None:
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o755)
        if os.geteuid() == 0:
            (point,) = drive("denied", Path(folder), 1)
            assert (point["code"], point["seen"]["wrong"]) == (3, [])
            assert "must be writable" in point["told"] and "Permission denied" in point["told"]
        else:
            url = f"{folder}/store"
            store = sample_store.make(url)
            store.discard(sample_store.ref_of("render"))
            os.chmod(Path(url, "scenes", sample_store.DIGEST, "render"), 0o555)
            with pytest.raises(StoreAccessError, match=r"must be writable.*Permission denied"):
                sample_store.make(url)
            os.chmod(Path(url, "scenes", sample_store.DIGEST, "render"), 0o755)


def test_denied_read_is_no_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Permission of the superuser cannot be taken away, so the file system is asked to say so.
    store = sample_store.make(str(tmp_path / "store"))
    kind = type(store.files.filesystem)
    cat_file = kind.cat_file

    def deny(self: Any, path: str, *args: Any, **kwargs: Any) -> bytes:
        if path.endswith(".exr"):
            raise PermissionError(13, "Permission denied", path)
        return cat_file(self, path, *args, **kwargs)

    monkeypatch.setattr(kind, "cat_file", deny)
    for ask in (lambda: store.read(sample_store.ref_of("render"), "frame.exr"), store.verify):
        with pytest.raises(StoreAccessError, match=r"must be readable.*Permission denied.*check the permissions"):
            ask()
