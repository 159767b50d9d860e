"""What only an S3 server can show: errors in one sentence, races, conditional puts, and the number of requests."""

import os
import subprocess
import sys
import threading
import urllib.request
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fsspec
import fsspec.config
import numpy as np
import pytest

from storage import layout, object_store
from storage.caches import ArraySpec, CacheSet
from storage.errors import (
    StoreAccessError,
    StoreNotFoundError,
    StoreUnreachableError,
    StoreUrlError,
)
from storage.store import Store, UnitRef
from storage.verification import find_problems, repair

DIGEST = "0123456789abcdef"
REF = UnitRef(DIGEST, "render", "ab" * 16)
BAKE = UnitRef(DIGEST, "bake", "cd" * 16)
ROWS = {"mean": np.arange(12, dtype=np.float32).reshape(4, 3)}
PORT_OF_NOBODY = 9


@pytest.fixture
def url(s3_url: str) -> str:
    return s3_url


@pytest.fixture
def store(url: str) -> Store:
    store = Store.open(url, create=True)
    store.register_scene(DIGEST, {"name": "kitchen"})
    return store


_KEPT: list[Any] = []  # zarr's clients cannot be closed from here, so they live until the process ends


@pytest.fixture
def fresh_clients(s3_bucket: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Clients are made anew, as they keep the endpoint and credentials that they were made with."""
    _KEPT.append({})
    monkeypatch.setattr(fsspec.get_filesystem_class("s3"), "_cache", _KEPT[-1])


@pytest.fixture
def requests(s3_endpoint: str, monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Counts the requests by operation."""
    counts: Counter[str] = Counter()
    s3 = fsspec.get_filesystem_class("s3")
    call: Callable[..., Any] = s3._call_s3

    async def counted(self: Any, method: str, *args: Any, **kwargs: Any) -> Any:
        counts[method] += 1
        return await call(self, method, *args, **kwargs)

    monkeypatch.setattr(s3, "_call_s3", counted)
    return counts


def bake(store: Store, num_units: int = 3) -> CacheSet:
    caches = CacheSet.create_or_open(store, BAKE, [ArraySpec("mean", (4 * num_units, 3), "float32", 4)], {})
    for index in range(num_units):
        caches.write_unit(index, ROWS, {})
    caches.commit({})
    return caches


# ------------------------------------------------------------------- errors


def test_missing_bucket_is_one_sentence_and_makes_no_bucket(s3_endpoint: str) -> None:
    for create in (False, True):
        with pytest.raises(StoreNotFoundError, match=r"bucket of store s3://no-such-bucket/x must exist.*create the"):
            Store.open("s3://no-such-bucket/x", create=create)
    assert not fsspec.filesystem("s3").exists("no-such-bucket")


def test_bucket_that_vanishes_is_no_empty_store(s3_endpoint: str) -> None:
    fsspec.filesystem("s3").mkdir("short-lived")
    store = Store.open("s3://short-lived", create=True)
    fsspec.filesystem("s3").rm("short-lived", recursive=True)
    for ask in (lambda: store.committed(REF), store.scenes, store.verify, lambda: store.units(DIGEST, "render")):
        with pytest.raises(StoreNotFoundError, match="bucket of store"):
            ask()


def test_denied_access_is_told_for_reads_writes_and_caches(store: Store, s3_endpoint: str) -> None:
    store.commit(REF, {"frame.exr": b"pixels"}, {})
    caches = bake(store)
    set_allowed_requests(s3_endpoint, "0")
    try:
        for denied in (
            lambda: Store.open(store.url),
            lambda: store.read(REF, "frame.exr"),
            lambda: store.commit(UnitRef(DIGEST, "render", "ef" * 16), {"a": b""}, {}),
            lambda: store.discard(REF),
            lambda: CacheSet.open(store, BAKE),
            lambda: caches.write_unit(0, ROWS, {}),
            caches.load,
            store.verify,
        ):
            with pytest.raises(StoreAccessError, match="AWS_ACCESS_KEY_ID"):
                denied()
    finally:
        set_allowed_requests(s3_endpoint, "inf")
    assert store.verify() == []  # nothing was half-done, and nothing was taken for damage


def set_allowed_requests(endpoint: str, count: str) -> None:
    """From then on the server knows no key, once `count` requests were answered."""
    request = urllib.request.Request(
        f"{endpoint}/moto-api/reset-auth", data=count.encode(), headers={"Content-Type": "text/plain"}
    )
    urllib.request.urlopen(request).close()


def test_network_failure_while_caches_are_read_is_no_damage(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    caches = bake(store)
    s3 = fsspec.get_filesystem_class("s3")
    cat_file = s3._cat_file

    async def fail(self: Any, path: str, *args: Any, **kwargs: Any) -> bytes:
        if "/c/" in path:
            raise TimeoutError("no answer")
        return await cat_file(self, path, *args, **kwargs)

    monkeypatch.setattr(s3, "_cat_file", fail)
    with pytest.raises(StoreUnreachableError, match="no answer"):
        caches.load()
    with pytest.raises(StoreUnreachableError, match="no answer"):
        store.verify()


@pytest.mark.usefixtures("fresh_clients")
def test_unreachable_endpoint_is_one_sentence(s3_endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(object_store._S3_OPTIONS, "config_kwargs", {"retries": {"max_attempts": 1}})
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{PORT_OF_NOBODY}")
    with pytest.raises(StoreUnreachableError, match=rf"must be reachable.*127\.0\.0\.1:{PORT_OF_NOBODY}.*AWS_ENDPOINT"):
        Store.open("s3://bucket/x", create=True)


@pytest.mark.usefixtures("fresh_clients")
def test_missing_credentials_are_one_sentence(
    s3_endpoint: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_PROFILE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "none"))
    monkeypatch.setenv("AWS_CONFIG_FILE", str(tmp_path / "none"))
    with pytest.raises(StoreAccessError, match="AWS_ACCESS_KEY_ID"):
        Store.open("s3://bucket/x")


def test_missing_package_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "s3fs", None)
    monkeypatch.delitem(sys.modules["fsspec.registry"]._registry, "s3", raising=False)
    with pytest.raises(StoreUrlError, match=r"install lightwell\[s3\]"):
        Store.open("s3://bucket/x")


@pytest.mark.parametrize("url", ["s3://", "s3:///", "nothing://bucket/x"])
def test_url_without_bucket_or_protocol_is_refused(url: str, s3_endpoint: str) -> None:
    with pytest.raises(StoreUrlError, match="store must"):
        Store.open(url, create=True)


@pytest.mark.usefixtures("fresh_clients")
def test_endpoint_and_key_may_come_from_fsspec(s3_endpoint: str, s3_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("AWS_ENDPOINT_URL", "AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    options = {"endpoint_url": s3_endpoint, "key": "testing", "secret": "testing"}
    monkeypatch.setitem(fsspec.config.conf, "s3", options)  # what FSSPEC_S3_ENDPOINT_URL, ... fill
    store = Store.open(s3_url, create=True)
    store.register_scene(DIGEST, {})
    bake(store)
    assert store.verify() == []


# -------------------------------------------------------------------- races


def test_loser_of_a_race_returns_and_reads_the_winners_unit(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    put_new = object_store.put_new
    others: list[dict[str, Any]] = []

    def late(filesystem: Any, path: str, data: bytes) -> bool:
        monkeypatch.setattr(object_store, "put_new", put_new)
        others.append(store.commit(REF, {"frame.exr": b"theirs"}, {"by": "other"}))
        return put_new(filesystem, path, data)

    monkeypatch.setattr(object_store, "put_new", late)
    assert store.commit(REF, {"frame.exr": b"ours!!"}, {"by": "us"}) == others[0]
    assert store.read(REF, "frame.exr") == b"theirs"
    (stray,) = find_problems(store)
    assert "belongs to no commit" in stray.text
    assert repair(store, stray)
    assert (store.verify(), store.read(REF, "frame.exr")) == ([], b"theirs")


def test_racing_threads_leave_whole_units(store: Store, url: str) -> None:
    start = threading.Barrier(4)
    refs = [UnitRef(DIGEST, "render", f"{turn:032x}") for turn in range(5)]

    def work(index: int) -> None:
        mine = Store.open(url)
        for ref in refs:
            start.wait()
            mine.commit(ref, {name: bytes([index]) * 50 for name in ("a", "b")}, {"by": index})

    threads = [threading.Thread(target=work, args=(index,)) for index in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert store.units(DIGEST, "render") == refs
    for ref in refs:
        by = (store.committed(ref) or {})["by"]
        assert store.read(ref, "a") + store.read(ref, "b") == bytes([by]) * 100
    assert all("belongs to no commit" in text for text in store.verify())


def test_two_processes_fill_one_cache_set(store: Store, url: str) -> None:
    code = (
        "import sys, numpy as np; from storage.store import Store, UnitRef\n"
        "from storage.caches import ArraySpec, CacheSet\n"
        "spec = ArraySpec('mean', (20, 3), 'float32', 4)\n"
        "caches = CacheSet.create_or_open(Store.open(sys.argv[1]), UnitRef(*sys.argv[2:]), [spec], {'a': 1})\n"
        "for i in range(5): caches.write_unit(i, {'mean': np.full((4, 3), i, np.float32)}, {})\n"
        "caches.commit({})"
    )
    command = [sys.executable, "-c", code, url, BAKE.scene_digest, BAKE.stage, BAKE.key]
    environment = {**os.environ, "PYTHONPATH": str(Path(layout.__file__).parents[1])}
    processes = [subprocess.Popen(command, env=environment, stderr=subprocess.PIPE) for _ in range(2)]
    told = [process.communicate(timeout=120)[1].decode() for process in processes]
    assert [process.returncode for process in processes] == [0, 0], told
    assert "Traceback" not in "".join(told) and "Unclosed" not in "".join(told), told
    assert CacheSet.open(store, BAKE).load()["mean"][:, 0].tolist() == [i for i in range(5) for _ in range(4)]
    assert store.verify() == []


@pytest.mark.parametrize("code", ["NotImplemented", "ConditionalRequestConflict", "PreconditionFailed"])
def test_servers_that_answer_a_condition_otherwise(store: Store, monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    # Older servers know no If-None-Match; AWS answers 409 while another put of the object has not ended.
    files = store.files.filesystem
    pipe_file = files.pipe_file
    answers = []

    def answer(path: str, data: bytes, **kwargs: Any) -> None:
        if kwargs.get("mode") == "create" and not answers:
            answers.append(code)
            error = OSError(5, code)
            error.__cause__ = ClientError(code)
            raise error
        pipe_file(path, data, **kwargs)

    monkeypatch.setattr(files, "pipe_file", answer)
    assert object_store.put_new(files, store.files.path("a"), b"1") is (code != "PreconditionFailed")
    assert answers == [code]
    assert object_store.put_new(files, store.files.path("b"), b"1")
    assert not object_store.put_new(files, store.files.path("b"), b"2")
    assert store.files.read("b") == b"1"


class ClientError(Exception):
    """As botocore's: the code is in the response."""

    def __init__(self, code: str) -> None:
        self.response = {"Error": {"Code": code}}


def test_denied_delete_is_told(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    # A request that deletes many objects succeeds although some were denied.
    bake(store)
    s3 = fsspec.get_filesystem_class("s3")

    async def omit(self: Any, paths: list[str], **kwargs: Any) -> list[str]:
        return []

    def deny(path: str) -> None:
        raise PermissionError("Access Denied")

    monkeypatch.setattr(s3, "_bulk_delete", omit)
    monkeypatch.setattr(store.files.filesystem, "rm_file", deny)
    with pytest.raises(StoreAccessError, match="Access Denied"):
        store.files.remove(BAKE.folder)


# ----------------------------------------------------------------- requests


def test_requests_of_a_unit_are_few_and_known(store: Store, requests: Counter[str]) -> None:
    store.commit(REF, {"frame.exr": b"pixels", "second": b""}, {})
    assert requests == {"get_object": 1, "put_object": 3}  # is it there; two files and the marker
    requests.clear()
    store.commit(REF, {"frame.exr": b"pixels", "second": b""}, {})
    assert requests == {"get_object": 1}
    requests.clear()
    store.read(REF, "frame.exr")
    assert requests == {"get_object": 2}  # marker, file
    requests.clear()
    store.discard(REF)
    assert requests["delete_object"] + requests["delete_objects"] <= 3
    assert requests["list_objects_v2"] <= 3


def test_requests_of_a_bake_unit_are_few_and_known(store: Store, requests: Counter[str]) -> None:
    caches = CacheSet.create_or_open(store, BAKE, [ArraySpec("mean", (12, 3), "float32", 4)], {})
    requests.clear()
    caches.write_unit(0, ROWS, {})
    assert requests == {"get_object": 2, "put_object": 2}  # is it there, chunk, the chunk read back, marker
    caches.write_unit(1, ROWS, {})
    caches.write_unit(2, ROWS, {})
    caches.commit({})
    requests.clear()
    caches.load()
    assert requests == {"list_objects_v2": 2, "get_object": 6}  # units, chunks; a marker and a chunk a unit


def test_listing_stands_for_a_request_each(store: Store, requests: Counter[str]) -> None:
    refs = [UnitRef(DIGEST, "render", f"{index:032x}") for index in range(20)]
    for ref in refs:
        store.commit(ref, {"frame.exr": b"pixels"}, {})
    requests.clear()
    assert store.units(DIGEST, "render") == refs
    assert requests == {"list_objects_v2": 1}
    requests.clear()
    assert store.verify() == []
    assert requests["get_object"] == 2 * len(refs) + 1  # marker and file of each unit, the scene's entry
    assert requests.total() - requests["get_object"] <= 4
