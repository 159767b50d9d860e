"""Cache sets on grids of several sizes: what is kept, what is resumed, and what the query reads of it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from storage.caches import CacheSet
from storage.errors import MissingUnitError
from storage.store import Store
from workers.bake import bake_refs, bake_sets, bake_units, load_caches, run_bake, seal_bake
from workers.bake_kernels import Batch
from workers.bake_lobes import DIFFUSE, Lobe, lobes_of
from workers.direction_grids import directional_cost
from workers.element_stage import load_elements, run_elements, save_elements
from workers.elements import ElementSet
from workers.query import QueryProgram
from workers.run_state import RunState
from workers.scene import load_scene
from workers.settings import Settings
from workers.texels import unpack_rows

GREY = {"type": "rgb", "value": [1.0, 1.0, 1.0]}
SETTINGS: dict[str, Any] = {
    "width": 24, "height": 24, "cache.max_elements": 400, "cache.domain_poses": 2, "cache.azimuth": 32,
    "cache.polar": 8, "cache.directional_spp": 4, "cache.elements_per_unit": 64, "cache.denoise": False,
}  # fmt: skip


def perfect_metal(alpha: float) -> dict[str, Any]:
    return {"type": "twosided", "b": {"type": "roughconductor", "material": "none", "distribution": "ggx",
                                      "alpha": alpha}}  # fmt: skip


def document() -> dict[str, Any]:
    """A rough, a smoother and a nearly specular tile in a row under a sky of 1, none of which sees another."""
    tiles = {
        f"tile{i}": {"type": "rectangle", "to_world": [{"translate": [2.2 * i - 2.2, 0, 0]}], "b": perfect_metal(alpha)}
        for i, alpha in enumerate([0.75, 0.4, 0.1])
    }
    look = {"look_at": {"origin": [0.0, -2.0, 6.0], "target": [0.0, 0.0, 0.0], "up": [0, 1, 0]}}
    sensor = {
        "type": "perspective",
        "fov": 50,
        "to_world": look,
        "film": {"type": "hdrfilm", "width": 24, "height": 24},
    }
    sky = {"type": "constant", "radiance": GREY}
    return {"sensor": sensor, "integrator": {"type": "path", "max_depth": 6}, "sky": sky, **tiles}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunState:
    folder = tmp_path_factory.mktemp("grids")
    path = Path(folder) / "tiles.yaml"
    path.write_text(yaml.safe_dump({"scene": document()}))
    store = Store.open(folder / "store", create=True)
    return RunState(load_scene(path), store, Settings.preset_named("tiny").override(SETTINGS))


@pytest.fixture(scope="module")
def elements(run: RunState) -> ElementSet:
    return run_elements(run)


@pytest.fixture(scope="module")
def baked(run: RunState, elements: ElementSet) -> dict[str, Any]:
    return run_bake(run, elements)


def with_settings(run: RunState, **overrides: Any) -> RunState:
    changed = RunState(run.scene, run.store, run.settings.override({f"cache.{k}": v for k, v in overrides.items()}))
    changed.table, changed.paths = run.table, run.paths
    return changed


def directional_lobes(run: RunState, elements: ElementSet) -> list[Lobe]:
    return [lobe for lobe in lobes_of(run, elements) if lobe.name != DIFFUSE]


def test_each_grid_has_a_set_of_its_own(baked: dict[str, Any]) -> None:
    assert set(baked) == {"directional-8x2", "directional-16x4", "directional-32x8"}  # no metal has a diffuse lobe


def test_sets_hold_packed_texels_and_say_how_wrong_they_may_be(run: RunState, elements: ElementSet, baked: Any) -> None:
    rows = 0
    for lobe in directional_lobes(run, elements):
        caches = CacheSet.open(run.store, baked[lobe.name])
        azimuth, polar = lobe.params["grid"]
        assert caches.specs["texels"].shape == (len(lobe.owners), polar, azimuth)
        assert caches.specs["texels"].dtype == "uint32" and caches.specs["top"].shape == (len(lobe.owners),)
        assert caches.attributes["encoding"] == "rgb9e5"
        assert caches.attributes["max_error_of_largest_channel"] == 2.0**-9
        rows += len(lobe.owners)
    assert rows == len(elements.glossy)


def test_stored_texels_are_what_the_kernel_gave_within_the_bound(
    run: RunState, elements: ElementSet, baked: Any
) -> None:
    for lobe in directional_lobes(run, elements):
        caches = CacheSet.open(run.store, baked[lobe.name])
        loaded = caches.load()
        stop = caches.specs["top"].rows(0).stop
        places = np.arange(stop, dtype=np.uint64)
        batch = Batch(lobe.owners[:stop], np.full(stop, caches.unit_seed(0), np.uint64), places)
        exact = lobe.kernel(batch, 0)["mean"]
        stored = unpack_rows(loaded["texels"][:stop], loaded["top"][:stop], signed=False)
        assert np.all(np.abs(stored - exact).max(-1) <= 2.0**-9 * exact.max(-1) + 1e-12)


def test_lost_units_are_baked_again_to_the_bit(run: RunState, elements: ElementSet, baked: Any) -> None:
    for name, ref in baked.items():
        caches = CacheSet.open(run.store, ref)
        before, last = caches.load(), caches.num_units - 1
        caches.discard_unit(last)
        with pytest.raises(MissingUnitError):
            seal_bake(run, elements, name)
        assert bake_units(run, elements, name, range(caches.num_units)) == ref == seal_bake(run, elements, name)
        after = CacheSet.open(run.store, ref).load()
        for array in before:
            np.testing.assert_array_equal(after[array], before[array])


def test_inventory_counts_the_paths_of_every_set(run: RunState, elements: ElementSet) -> None:
    sets = bake_sets(run, elements)
    assert set(sets) == set(bake_refs(run, elements))
    per_element = [found.lanes_per_unit / run.settings.cache.elements_per_unit for found in sets.values()]
    cost = directional_cost(elements, run.settings.cache)
    owners = [len(lobe.owners) for lobe in directional_lobes(run, elements)]
    assert sum(a * b for a, b in zip(per_element, owners, strict=True)) == cost["paths"]
    uniform = directional_cost(elements, with_settings(run, grids="uniform").settings.cache)
    assert cost["paths"] < 0.7 * uniform["paths"] and cost["texels"] < 0.6 * uniform["texels"]


def test_settings_that_change_bytes_change_keys(run: RunState, elements: ElementSet) -> None:
    changes: list[dict[str, Any]] = [
        {}, {"grids": "uniform"}, {"texels": "float32"}, {"azimuth": 16, "polar": 4}, {"grids": "uniform", "polar": 4}
    ]  # fmt: skip
    refs = [bake_refs(with_settings(run, **change), elements) for change in changes]
    found = [{ref.key for name, ref in one.items() if name != DIFFUSE} for one in refs]
    for i, one in enumerate(found):
        assert all(one.isdisjoint(other) for other in found[:i]), changes[i]


def test_white_furnace_on_mixed_grids(run: RunState, elements: ElementSet, baked: Any) -> None:
    """Perfect metals under a sky of 1 show their directional albedo: 1 for the smooth one, less for the rough ones
    (Mitsuba's microfacets lose what bounces twice), on every grid as on one fine grid for all, to the noise of the
    latter and the average over 45 degrees of the coarsest."""
    shown = {}
    for name, one in {"adaptive": run, "uniform": with_settings(run, grids="uniform", texels="float32")}.items():
        run_bake(one, elements)
        caches = load_caches(one, elements)
        program = QueryProgram(one.scene.mi_scene, one.table, elements, caches, one.settings.query)
        shown[name] = program.run(one.scene.camera)
        shown[name][shown[name][..., 9] == 0, :3] = np.nan  # the sky
    columns = [slice(0, 7), slice(9, 15), slice(17, 24)]
    albedo = {name: [float(np.nanmean(image[:, c, :3])) for c in columns] for name, image in shown.items()}
    np.testing.assert_allclose(albedo["adaptive"], albedo["uniform"], atol=0.03)
    assert albedo["adaptive"] == sorted(albedo["adaptive"]) and abs(albedo["adaptive"][2] - 1) < 0.03


def test_denoised_sets_average_their_own_grid(run: RunState, elements: ElementSet, baked: Any) -> None:
    noisy = load_caches(run, elements).texels
    smooth = load_caches(with_settings(run, denoise=True), elements).texels
    for (_, before), (_, after) in zip(noisy.grids(), smooth.grids(), strict=True):
        assert after.std() <= before.std() and abs(after.mean() / before.mean() - 1) < 0.02


def test_elements_keep_the_spread(elements: ElementSet) -> None:
    np.testing.assert_array_equal(load_elements(save_elements(elements)).spread, elements.spread)
    assert len(elements.spread) == len(elements.glossy) > 0


def test_exitant_caches_stay_as_in_the_paper(run: RunState) -> None:
    paper = with_settings(run, lobes="exitant", elements="triangle")
    elements = run_elements(paper)
    (lobe,) = directional_lobes(paper, elements)
    assert (lobe.name, lobe.signed, lobe.arrays) == ("directional", None, {"mean": (8, 32, 3)})
    run_bake(paper, elements)
    texels = load_caches(paper, elements).texels
    assert texels.rung is None and texels.packing is None
