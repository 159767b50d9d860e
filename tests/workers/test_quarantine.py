"""Units over their health limit are set aside with their reason, named, and tried again by the next run."""

import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from storage.caches import ArraySpec, CacheSet
from storage.store import Store, UnitRef
from workers import bake, render
from workers.bake import _bake_units
from workers.bake_lobes import Lobe
from workers.camera import Camera
from workers.errors import QuarantinedError
from workers.pathtrace import trace
from workers.progress import Progress
from workers.render import run_render
from workers.run_state import RunState
from workers.scene import load_scene
from workers.settings import Settings

PER_UNIT = 4
NUM_UNITS = 3


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store.open(tmp_path / "store", create=True)


def test_bake_unit_over_its_limit_is_set_aside_and_the_others_are_kept(store: Store) -> None:
    ref = UnitRef("0123456789abcdef", "bake", "ab" * 16)
    caches = CacheSet.create_or_open(
        store, ref, [ArraySpec("mean", (PER_UNIT * NUM_UNITS, 3), "float32", PER_UNIT)], {}
    )
    run: Any = types.SimpleNamespace(settings=Settings.preset_named("tiny"), store=store, progress=Progress())
    values = np.ones((PER_UNIT * NUM_UNITS, 3), np.float32)
    values[PER_UNIT] = np.nan  # in unit 1
    lobe = Lobe("diffuse", {}, {"mean": (3,)}, np.arange(len(values)), 1, lambda batch, index: {"mean": values})
    with pytest.raises(QuarantinedError, match=r"bake unit 1 of the diffuse lobe must be finite, got 3 of 12 values"):
        _bake_units(run, lobe, caches, [0, 1, 2], PER_UNIT)
    assert caches.committed_units() == {0, 2}
    (record,) = store.quarantined()
    assert (record["unit"], record["attempts"], record["cause"]) == (1, 1, "health")
    assert "bake unit 1" in record["reason"] and record["facts"]["non_finite"] == 3

    with pytest.raises(QuarantinedError):
        _bake_units(run, one_unit(lobe, values[PER_UNIT : 2 * PER_UNIT]), caches, [1], PER_UNIT)
    assert store.quarantined()[0]["attempts"] == 2

    _bake_units(run, one_unit(lobe, np.ones((PER_UNIT, 3), np.float32)), caches, [1], PER_UNIT)
    assert (caches.committed_units(), store.quarantined()) == ({0, 1, 2}, [])


def one_unit(lobe: Lobe, values: np.ndarray) -> Lobe:
    return Lobe(lobe.name, {}, lobe.arrays, lobe.owners, 1, lambda batch, index: {"mean": values})


def test_stray_values_are_zeroed_and_counted() -> None:
    values = np.ones((20_000, 3), np.float32)
    values[7, 1] = np.inf
    rows = {"mean": values}
    assert bake._checked_health("diffuse", 0, rows) == {"non_finite": 1, "negative": 0}
    assert rows["mean"][7].tolist() == [1.0, 0.0, 1.0]


def test_frame_over_its_limit_is_set_aside_and_tried_again(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene("tiny", width=16, height=16)
    run = RunState(scene, store, Settings.preset_named("tiny"))
    cameras: list[Camera] = [scene.camera]

    def broken(*args: Any, **kwargs: Any) -> Any:
        image = trace(*args, **kwargs)
        image.radiance[:2] = np.nan
        return image

    with monkeypatch.context() as patch:
        patch.setattr(render, "trace", broken)
        with pytest.raises(QuarantinedError, match=r"ground truth render/.* must be finite, got \d+ of \d+ pixels"):
            run_render(run, cameras, 4, "render")
    (record,) = store.quarantined(scene.digest)
    assert record["stage"] == "render" and "pixels NaN or Inf" in record["reason"]
    assert store.units(scene.digest, "render") == []
    (ref,) = run_render(run, cameras, 4, "render")
    assert store.committed(ref) is not None
    assert store.quarantined() == []
