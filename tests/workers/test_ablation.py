"""Ablation rows: their names, and what caches on every triangle would cost."""

from pathlib import Path

import pytest

from storage.store import Store
from workers.ablation import bake_cost, chosen_variants, variants
from workers.bake import run_bake
from workers.element_stage import run_elements
from workers.errors import WorkerError
from workers.run_state import RunState
from workers.scene import load_scene
from workers.settings import Settings

SETTINGS = Settings.preset_named("tiny").override({"width": 24, "height": 16, "cache.domain_poses": 2})
UNIFORM = {"cache.elements": "triangle", "cache.lobes": "exitant", "cache.azimuth": 8, "cache.polar": 2,
           "cache.directional_spp": 3, "cache.max_edge_fraction": 0}  # fmt: skip


def test_rows_are_chosen_by_name_in_their_own_order() -> None:
    names = [row.name for row in variants(SETTINGS)]
    assert len(set(names)) == len(names)
    assert [row.name for row in chosen_variants(SETTINGS)] == names
    assert [row.name for row in chosen_variants(SETTINGS, ["ours", names[0]])] == [names[0], "ours"]
    with pytest.raises(WorkerError, match=r"must be one of .*ours.*, got 'hers'"):
        chosen_variants(SETTINGS, ["hers"])


def test_cost_of_every_triangle_counts_the_unseen_ones(tmp_path: Path) -> None:
    store = Store.open(tmp_path / "store", create=True)
    run = RunState(load_scene("tiny", width=24, height=16), store, SETTINGS.override(UNIFORM))
    elements = run_elements(run)
    run_bake(run, elements)
    cost = bake_cost(run, elements)
    assert cost["bake_paths"] == elements.num_elements * 8 * 2 * 3
    assert cost["whole_paths"] == pytest.approx(run.table.num_prims * 8 * 2 * 3)
    assert elements.num_elements < run.table.num_prims
    assert cost["whole_nbytes"] / cost["cache_nbytes"] == pytest.approx(cost["whole_paths"] / cost["bake_paths"])
