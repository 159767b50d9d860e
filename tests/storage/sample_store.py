"""A small store with every kind of committed file, made the way that a run makes it: whatever is missing."""

import hashlib
from typing import Any

import numpy as np

from storage import layout
from storage.caches import ArraySpec, CacheSet
from storage.keys import unit_key
from storage.store import Store, UnitRef

DIGEST = "0123456789abcdef"
NUM_BAKE_UNITS = 3
SPECS = [ArraySpec("mean", (10, 3), "float32", 4), ArraySpec("square", (10, 3), "float32", 4)]
UNITS: dict[str, dict[str, bytes]] = {
    "render": {"frame.exr": b"pixels" * 900},
    "train": {"network.safetensors": bytes(range(256)) * 40, "network.json": b'{"widths": [8, 16]}'},
    "checkpoint": {"state.pt": b"tensors" * 700},
}
BAKE = UnitRef(DIGEST, "bake", unit_key(DIGEST, "bake", {}, 1))


def ref_of(stage: str) -> UnitRef:
    return UnitRef(DIGEST, stage, unit_key(DIGEST, stage, {}, 1))


def make(url: str) -> Store:
    """Makes whatever the store lacks, as a run does."""
    store = Store.open(url, create=True)
    store.register_scene(DIGEST, {"name": "kitchen", "psnr": 31.25})
    if store.committed(BAKE) is None:
        caches = CacheSet.create_or_open(store, BAKE, SPECS, {"lobe": "diffuse"})
        for index in sorted(set(range(NUM_BAKE_UNITS)) - caches.committed_units()):
            caches.write_unit(index, rows_of(index), {"seconds": 0.5})
        caches.commit({"passes": 4})
    for stage, files in UNITS.items():
        if store.committed(ref_of(stage)) is None:
            store.commit(ref_of(stage), files, {"seconds": 1.5})
    return store


def rows_of(index: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(index)
    return {spec.name: rng.normal(size=spec.unit_shape(index)).astype(np.float32) for spec in SPECS}


def reads(store: Store) -> dict[str, Any]:
    """Every question that a reader may ask, by name; each answers with bytes, None, or a StorageError."""
    questions: dict[str, Any] = {
        f"{stage}/{name}": lambda stage=stage, name=name: store.read(ref_of(stage), name)
        for stage, files in UNITS.items()
        for name in files
    }
    for spec in SPECS:
        questions[f"bake/{spec.name}"] = lambda spec=spec: CacheSet.open(store, BAKE).load()[spec.name].tobytes()
    questions["scene"] = lambda: repr(sorted(store.find_scene("kitchen").items())).encode()
    return questions


def answers(store: Store) -> dict[str, bytes]:
    return {name: ask() for name, ask in reads(store).items()}


def expected() -> dict[str, bytes]:
    """What the questions must be answered with, if at all."""
    truth = {f"{stage}/{name}": data for stage, files in UNITS.items() for name, data in files.items()}
    for spec in SPECS:
        truth[f"bake/{spec.name}"] = b"".join(rows_of(index)[spec.name].tobytes() for index in range(NUM_BAKE_UNITS))
    entry = {"digest": DIGEST, "name": "kitchen", "psnr": 31.25}
    return truth | {"scene": repr(sorted(entry.items())).encode()}


def content(store: Store) -> dict[str, str]:
    """Digest of every file at rest but the markers, which carry times, by path; records of quarantine left out."""
    paths = [path for path in store.files.sizes(layout.SCENES) if not is_marker(path)]
    return {path: hashlib.sha256(store.files.read(path) or b"").hexdigest() for path in paths}


def is_marker(path: str) -> bool:
    return path.endswith(f"/{layout.MARKER}") or f"/{layout.UNIT_MARKERS}/" in path


def places(store: Store) -> dict[str, str]:
    """Path of one file of each kind."""
    frame, train, checkpoint = ref_of("render"), ref_of("train"), ref_of("checkpoint")

    def file(ref: UnitRef, name: str) -> str:
        return layout.stored_file(ref.folder, name, (store.committed(ref) or {})["files"][name])

    return {
        "store.json": layout.STORE_FILE,
        "scene.json": layout.scene_file(DIGEST),
        "marker": layout.unit_marker(frame.folder),
        "frame": file(frame, "frame.exr"),
        "weights": file(train, "network.safetensors"),
        "weights' JSON": file(train, "network.json"),
        "checkpoint": file(checkpoint, "state.pt"),
        "chunk": f"{BAKE.folder}/{layout.chunk_file('mean', 1, 2)}",
        "last chunk": f"{BAKE.folder}/{layout.chunk_file('square', 2, 2)}",
        "bake unit's marker": layout.bake_marker(BAKE.folder, 1),
        "cache set's marker": layout.unit_marker(BAKE.folder),
        "zarr group": f"{BAKE.folder}/caches.zarr/zarr.json",
        "zarr array": f"{BAKE.folder}/caches.zarr/mean/zarr.json",
    }
