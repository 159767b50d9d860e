"""Cache sets: round trips, resume, and damage that must never become zeros."""

import pickle
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest

from storage import layout
from storage.caches import ArraySpec, CacheSet
from storage.errors import (
    CacheMismatchError,
    CanonicalError,
    DamagedUnitError,
    MissingUnitError,
    StorageError,
)
from storage.store import Store, UnitRef

REF = UnitRef("0123456789abcdef", "bake", "ab" * 16)
SPECS = [ArraySpec("diffuse", (10, 3), "float32", 4), ArraySpec("specular", (10, 2, 4, 3), "float16", 4)]
ATTRIBUTES = {"directions": [2, 4], "unit": "W/(m^2 sr)"}


@pytest.fixture(params=["local", "memory", "s3"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Any:
    url = {"local": str(tmp_path / "Läger [1]"), "memory": f"memory://{tmp_path.name}/store"}.get(request.param)
    url = url or f"{request.getfixturevalue('s3_url')}/Läger [1]"
    store = Store.open(url, create=True)
    store.register_scene(REF.scene_digest, {})
    yield store
    fsspec.filesystem("memory").store.clear()


@pytest.fixture
def caches(store: Store) -> CacheSet:
    return CacheSet.create_or_open(store, REF, SPECS, ATTRIBUTES)


def rows_of(index: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(index)
    return {spec.name: rng.normal(size=spec.unit_shape(index)).astype(spec.dtype) for spec in SPECS}


def fill(caches: CacheSet) -> None:
    for index in range(caches.num_units):
        caches.write_unit(index, rows_of(index), {"seconds": 0.5})


def path_of(store: Store, index: int) -> str:
    return store.files.path(f"{REF.folder}/{layout.chunk_file('specular', index, 4)}")


def test_load_returns_what_was_written(store: Store, caches: CacheSet) -> None:
    fill(caches)
    loaded = CacheSet.open(store, REF).load()
    for spec in SPECS:
        expected = np.concatenate([rows_of(index)[spec.name] for index in range(3)])
        np.testing.assert_array_equal(loaded[spec.name], expected, strict=True)
    assert store.verify() == []


def test_non_finite_values_are_kept(caches: CacheSet) -> None:
    fill(caches)
    caches.discard_unit(1)
    rows = rows_of(1)
    rows["diffuse"][0] = [np.nan, np.inf, -0.0]
    caches.write_unit(1, rows, {})
    assert caches.load()["diffuse"][4].tobytes() == rows["diffuse"][0].tobytes()


def test_black_units_are_written_and_not_implied(store: Store, caches: CacheSet) -> None:
    for reopened in (
        caches,
        CacheSet.create_or_open(store, REF, SPECS, ATTRIBUTES),
        CacheSet.open(store, REF),
    ):
        zeros = {spec.name: np.zeros(spec.unit_shape(0), spec.dtype) for spec in SPECS}
        reopened.write_unit(0, zeros, {})
        assert store.files.filesystem.exists(path_of(store, 0))
        reopened.discard_unit(0)
        store.files.filesystem.rm_file(path_of(store, 0))


def test_committed_units_drive_the_resume(store: Store, caches: CacheSet) -> None:
    caches.write_unit(2, rows_of(2), {})
    resumed = CacheSet.create_or_open(store, REF, SPECS, ATTRIBUTES)
    assert (resumed.num_units, resumed.committed_units()) == (3, {2})
    assert resumed.attributes == ATTRIBUTES
    with pytest.raises(MissingUnitError, match=r"got 2 without: 0, 1;"):
        resumed.load()


def test_unit_record_holds_seed_and_health(caches: CacheSet) -> None:
    assert caches.unit_record(1) is None
    record = caches.write_unit(1, rows_of(1), {"health": {"nan": np.int64(0)}})
    assert record == caches.unit_record(1)
    assert (record["unit"], record["seed"], record["health"]) == (1, caches.unit_seed(1), {"nan": 0})
    assert caches.unit_seed(1) != caches.unit_seed(2)
    assert caches.write_unit(2, rows_of(2), {"seed": 0})["seed"] == 0


def test_write_again_leaves_the_first(caches: CacheSet) -> None:
    fill(caches)
    caches.write_unit(0, {name: array * 0 for name, array in rows_of(0).items()}, {})
    np.testing.assert_array_equal(caches.load()["diffuse"][:4], rows_of(0)["diffuse"])


def test_missing_chunk_is_an_error_and_never_zeros(store: Store, caches: CacheSet) -> None:
    fill(caches)
    store.files.filesystem.rm_file(path_of(store, 1))
    with pytest.raises(MissingUnitError, match=r"without: 1 \(no .*specular/c/1/0/0/0\)"):
        caches.load()
    assert "is missing" in store.verify()[0]


def test_missing_marker_is_an_error(store: Store, caches: CacheSet) -> None:
    fill(caches)
    store.files.filesystem.rm_file(store.files.path(layout.bake_marker(REF.folder, 1)))
    assert caches.committed_units() == {0, 2}
    with pytest.raises(MissingUnitError, match="got 1 without: 1;"):
        caches.load()


@pytest.mark.parametrize("damage", ["flip", "truncate", "empty", "swap"])
@pytest.mark.parametrize("unit", [1, 2])  # the last unit is shorter than its chunk
def test_damaged_chunk_is_found_and_can_be_baked_again(store: Store, caches: CacheSet, unit: int, damage: str) -> None:
    fill(caches)
    files, path = store.files.filesystem, path_of(store, unit)
    data = files.cat_file(path)
    middle = len(data) // 2
    changed = {
        "flip": data[:middle] + bytes([data[middle] ^ 4]) + data[middle + 1 :],
        "truncate": data[:-3],
        "empty": b"",
        "swap": files.cat_file(path_of(store, 0)),  # a valid chunk of another unit: only SHA-256 can tell
    }[damage]
    files.pipe_file(path, changed)
    with pytest.raises(DamagedUnitError, match=rf"bake unit {unit} .*verify --store"):
        caches.load()
    assert len(store.verify()) == 1
    caches.discard_unit(unit)
    caches.write_unit(unit, rows_of(unit), {})
    np.testing.assert_array_equal(caches.load()["specular"][4 * unit : 4 * unit + 4], rows_of(unit)["specular"])
    assert store.verify() == []


def test_damaged_marker_is_found(store: Store, caches: CacheSet) -> None:
    fill(caches)
    path = store.files.path(layout.bake_marker(REF.folder, 1))
    data = store.files.filesystem.cat_file(path)
    store.files.filesystem.pipe_file(path, data.replace(b'"seconds": 0.5', b'"seconds": 0.6'))
    with pytest.raises(DamagedUnitError, match=r"000001\.json"):
        caches.load()


@pytest.mark.parametrize("name", ["zarr.json", "diffuse/zarr.json"])
@pytest.mark.parametrize("content", [b"", b"{}", b"\xff", b'{"zarr_format": 3, "node_type": "group"}'])
def test_damaged_metadata_is_found(store: Store, caches: CacheSet, name: str, content: bytes) -> None:
    # zarr reads some of these as "no array here" or "no attributes": the marker of the set must tell.
    fill(caches)
    caches.commit({})
    path = store.files.path(f"{REF.folder}/caches.zarr/{name}")
    store.files.filesystem.pipe_file(path, content)
    with pytest.raises(DamagedUnitError, match=r"zarr\.json (has|differs)"):
        CacheSet.open(store, REF)
    assert len(store.verify()) == 1


def test_unreadable_metadata_of_a_running_bake_is_found(store: Store, caches: CacheSet) -> None:
    store.files.filesystem.pipe_file(store.files.path(f"{REF.folder}/caches.zarr/diffuse/zarr.json"), b"\xff")
    with pytest.raises(DamagedUnitError, match=r"caches\.zarr cannot be opened"):
        CacheSet.create_or_open(store, REF, SPECS, ATTRIBUTES)


def test_load_refuses_a_set_that_lost_an_array(store: Store, caches: CacheSet) -> None:
    fill(caches)
    group = b'{"zarr_format": 3, "node_type": "group"}'
    store.files.filesystem.pipe_file(store.files.path(f"{REF.folder}/caches.zarr/diffuse/zarr.json"), group)
    with pytest.raises(DamagedUnitError, match="lacks"):
        CacheSet.open(store, REF).load()


def test_interrupted_creation_is_completed(store: Store) -> None:
    CacheSet.create_or_open(store, REF, SPECS[:1], ATTRIBUTES)
    fill(CacheSet.create_or_open(store, REF, SPECS, ATTRIBUTES))
    assert CacheSet.open(store, REF).load().keys() == {"diffuse", "specular"}


def test_commit_marks_the_set_and_verify_covers_it(store: Store, caches: CacheSet) -> None:
    with pytest.raises(MissingUnitError):
        caches.commit({})
    assert store.units(REF.scene_digest, "bake") == []
    fill(caches)
    record = caches.commit({"seconds": 3})
    assert caches.commit({"seconds": 4}) == record == store.committed(REF)
    assert (record["num_units"], record["seconds"]) == (3, 3)
    assert store.units(REF.scene_digest, "bake") == [REF]
    assert caches.nbytes == store.nbytes(REF) > 0
    assert store.verify() == []
    store.discard(REF)
    assert caches.committed_units() == set()


def test_discarded_unit_of_a_finished_set_is_baked_again(store: Store, caches: CacheSet) -> None:
    fill(caches)
    caches.commit({})
    caches.discard_unit(1)
    assert store.committed(REF) is None
    assert caches.committed_units() == {0, 2}
    fill(caches)
    caches.commit({})
    assert store.verify() == []


def test_quarantined_unit_is_not_committed_and_told(store: Store, caches: CacheSet) -> None:
    record = caches.quarantine_unit(1, "9 values are NaN", {"nan": 9})
    assert (record["unit"], record["attempts"], record["facts"]) == (1, 1, {"nan": 9})
    assert caches.committed_units() == set()
    assert store.quarantined() == [record]
    caches.write_unit(1, rows_of(1), {})
    assert store.quarantined() == []


def test_open_refuses_a_set_that_is_not_there(store: Store) -> None:
    with pytest.raises(MissingUnitError, match="run the bake first"):
        CacheSet.open(store, REF)


def test_other_arrays_or_attributes_under_one_key_are_refused(store: Store, caches: CacheSet) -> None:
    other = [ArraySpec("diffuse", (10, 4), "float32", 4)]
    with pytest.raises(CacheMismatchError, match="make what differs part of the key"):
        CacheSet.create_or_open(store, REF, other, ATTRIBUTES)
    with pytest.raises(CacheMismatchError, match="make what differs part of the key"):
        CacheSet.create_or_open(store, REF, SPECS, {"directions": [4, 2]})


@pytest.mark.parametrize(
    ("index", "change"),
    [
        (3, {}),
        (-1, {}),
        (0, {"diffuse": np.zeros((3, 3), np.float32)}),
        (0, {"diffuse": np.zeros((4, 3), np.float64)}),
        (0, {"unknown": np.zeros((4, 3), np.float32)}),
    ],
)
def test_write_unit_refuses_rows_that_do_not_fit(caches: CacheSet, index: int, change: dict[str, Any]) -> None:
    with pytest.raises(CacheMismatchError):
        caches.write_unit(index, {**rows_of(0), **change}, {})
    assert caches.committed_units() == set()


def test_write_unit_refuses_a_bad_record_before_it_writes(store: Store, caches: CacheSet) -> None:
    with pytest.raises(CanonicalError):
        caches.write_unit(0, rows_of(0), {"seconds": float("nan")})
    assert not store.files.filesystem.exists(path_of(store, 0))


@pytest.mark.parametrize(
    "specs",
    [
        [],
        [SPECS[0], SPECS[0]],
        [SPECS[0], ArraySpec("b", (10,), "float32", 5)],
    ],
)
def test_create_refuses_arrays_that_disagree(store: Store, specs: list[ArraySpec]) -> None:
    with pytest.raises(CacheMismatchError, match="distinct names and one common number of units"):
        CacheSet.create_or_open(store, REF, specs, {})


@pytest.mark.parametrize(
    ("name", "shape", "rows"), [("a", (0, 3), 4), ("a", (4, 0), 4), ("a", (4,), 0), ("a/b", (4,), 1)]
)
def test_array_spec_refuses_empty_arrays_and_paths(name: str, shape: tuple[int, ...], rows: int) -> None:
    with pytest.raises(StorageError):
        ArraySpec(name, shape, "float32", rows)


def test_one_row_units_and_one_axis_arrays_work(store: Store) -> None:
    caches = CacheSet.create_or_open(store, REF, [ArraySpec("a", (3,), "uint32", 1)], {})
    for index in range(3):
        caches.write_unit(index, {"a": np.array([index], np.uint32)}, {})
    assert caches.load()["a"].tolist() == [0, 1, 2]


def test_cache_set_survives_pickling(caches: CacheSet) -> None:
    if caches.store.url.startswith("memory"):
        pytest.skip("memory does not reach another process")
    copy = pickle.loads(pickle.dumps(caches))
    copy.write_unit(0, rows_of(0), {})
    assert caches.committed_units() == {0}
