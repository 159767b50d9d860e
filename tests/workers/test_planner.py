"""Plans of small scenes: what they choose, what they leave, and whether they say what a run does."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import pytest

from storage.caches import CacheSet
from storage.store import Store
from tests.workers.planned_scenes import SKY, open_run, scene_file
from workers.audit import SceneAudit, audit_scene
from workers.bake import bake_refs, run_bake
from workers.camera_path import domain_poses
from workers.direction_grids import directional_cost
from workers.element_stage import run_elements
from workers.plan import Choice
from workers.plan_cost import Rates, compressed_share, stage_costs
from workers.plan_stage import FILE, plan_ref, planned_run
from workers.planner import GRIDS, Decision, _Planner, decide, grid_for, sharpest_alpha
from workers.run_state import PATH_SEED, RunState
from workers.scene import load_scene
from workers.settings import Settings, SettingsError

ROUGH = {"type": "roughconductor", "alpha": 0.5}
RATES = Rates(elements_s=1.0, diffuse=1e6, directional=1e6, frames=1e6, step_s={(16, 16, 16): 0.1})
GATHERING = dataclasses.replace(RATES, gathered=1e6)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Decision:
    """A grey floor under a white sky."""
    return decide(open_run(scene_file(tmp_path_factory.mktemp("plain"), light=SKY)))


@pytest.fixture(scope="module")
def rough_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The floor with a rough metal ball."""
    return scene_file(tmp_path_factory.mktemp("rough"), ROUGH, light=SKY)


@pytest.fixture(scope="module")
def rough(rough_file: Path) -> Decision:
    return decide(open_run(rough_file))


def choice(decision: Decision, item: str) -> Choice:
    return next(each for each in decision.choices if each.item == item)


def decided_again(decision: Decision, settings: Settings) -> Decision:
    """From the same audit and pilot with other settings."""
    parts = (decision.audit, decision.elements, decision.pilot, decision.element_set)
    return _Planner(settings, *parts).decision()


def small(**chosen: Any) -> Settings:
    return Settings.preset_named("tiny").override({"cache.max_elements": 300}).choose(chosen)


def test_choosing_remembers_what_a_person_set() -> None:
    settings = Settings.preset_named("tiny").choose({"width": 32, "cache.diffuse_spp": "64"})
    assert settings.plan.keep == ("cache.diffuse_spp",), "64 is also the preset's, but it was asked for"
    assert settings.choose({"train.epochs": 2}).plan.keep == ("cache.diffuse_spp", "train.epochs")
    assert Settings.from_json(json.loads(json.dumps(settings.to_json()))) == settings
    with pytest.raises(SettingsError, match=r"plan\.noise"):
        settings.override({"plan.noise": 0})


def test_grid_follows_roughness() -> None:
    assert [grid_for(alpha) for alpha in (1.0, 0.5, 0.2, 0.05, 0.0)] == [
        GRIDS[0], GRIDS[0], GRIDS[1], GRIDS[2], GRIDS[2]]  # fmt: skip


def test_scene_without_glossy_materials_has_no_directions(plain: Decision) -> None:
    assert choice(plain, "directions").choice == choice(plain, "directional lobe").choice == "none"
    assert "cache.directional_spp" not in plain.overrides
    assert not plain.network_needed and "not needed" in choice(plain, "network").choice
    wide = decided_again(plain, small().override({"train.widths": (32, 48, 64)}))
    assert wide.overrides["train.widths"] == (16, 16, 16)
    assert "train.epochs" not in wide.overrides, "to train none is for people to say"
    paper = decided_again(plain, small(**{"cache.lobes": "exitant"}))
    assert paper.network_needed, "the paper's caches are never enough"


def test_glossy_and_glass_balls_need_a_network(rough: Decision, tmp_path: Path) -> None:
    glass = decide(open_run(scene_file(tmp_path, {"type": "dielectric"}, light=SKY)))
    assert rough.network_needed and glass.network_needed
    assert choice(glass, "delta surfaces").choice.startswith("followed")


def test_plan_repeats_itself(rough: Decision, rough_file: Path) -> None:
    again = decide(open_run(rough_file))
    assert (rough.overrides, rough.choices) == (again.overrides, again.choices)


def test_a_persons_setting_stays_and_the_plan_says_so(rough: Decision) -> None:
    assert "cache.directional_spp" in rough.overrides, "else the next lines show nothing"
    kept = decided_again(rough, small(**{"cache.directional_spp": 4}))
    assert "cache.directional_spp" not in kept.overrides
    said = choice(kept, "directional lobe")
    assert said.by == "you" and said.choice.startswith("4 ") and "set by you" in said.reason
    assert choice(rough, "directional lobe").by == "plan"


def test_lower_goal_asks_for_more_paths_and_stays_within_twice_the_given(rough: Decision) -> None:
    plans = [decided_again(rough, small(**{"plan.noise": goal})) for goal in (0.5, 1e-4)]
    assert [plan.overrides.get("cache.directional_spp", 4) for plan in plans] == [1, 8]


def test_textured_roughness_counts_with_its_sharpest_texel(tmp_path: Path) -> None:
    alpha = {"type": "checkerboard", "color0": 0.05, "color1": 0.5}
    run = open_run(scene_file(tmp_path, {"type": "roughconductor", "alpha": alpha}, light=SKY))
    audit = audit_scene(run.scene.mi_scene, run.table, domain_poses(run.paths, 2, PATH_SEED), 2304)
    assert sharpest_alpha(audit) == pytest.approx(0.05)


def test_no_visible_material_is_as_rough_as_can_be() -> None:
    nothing = SceneAudit(materials=(), num_shapes=0, num_primitives=0, area=0.0, hit_share=0.0, channels={})
    assert sharpest_alpha(nothing) == 1.0


def test_planned_run_is_stored_read_again_and_marked(
    rough_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store.open(str(tmp_path / "store"), create=True)
    run = open_run(rough_file, store, **{"plan.mode": "adaptive"})
    planned = planned_run(run)
    assert planned.settings.plan.mode == "applied" and planned_run(planned) is planned
    kept = json.loads(store.read(plan_ref(run), FILE))
    assert kept["overrides"] and {row["item"] for row in kept["choices"]} >= {"directions", "network"}
    for key, value in kept["overrides"].items():
        section, name = key.split(".")
        assert planned.settings.to_json()[section][name] == value
    monkeypatch.setattr("workers.plan_stage.decide", None)  # a second plan would fail
    assert planned_run(run).settings == planned.settings
    preset = open_run(rough_file, store)
    assert planned_run(preset) is preset


def test_predicted_paths_and_bytes_are_those_of_the_bake(tmp_path: Path) -> None:
    store = Store.open(str(tmp_path / "store"), create=True)
    scene = load_scene("tiny", width=64, height=64)
    run = RunState(scene, store, Settings.preset_named("tiny"))
    decision = decide(run)
    costs = {cost.stage: cost for cost in stage_costs(run.settings, decision.element_set, GATHERING, decision.pilot)}
    elements = run_elements(run)
    run_bake(run, elements)
    cache = run.settings.cache
    assert costs["bake diffuse-traced"].paths == len(elements.diffuse) * cache.diffuse_spp // 4
    assert costs["bake diffuse"].paths == len(elements.diffuse) * cache.diffuse_spp // 2
    directional = [cost for stage, cost in costs.items() if stage.startswith("bake directional")]
    assert sum(cost.paths for cost in directional) == directional_cost(elements, cache)["paths"]
    for lobe, ref in bake_refs(run, elements).items():
        assert costs[f"bake {lobe}"].nbytes == pytest.approx(CacheSet.open(store, ref).nbytes, rel=0.1), lobe


def test_time_of_training_is_limited_by_its_budget(plain: Decision) -> None:
    def seconds(**overrides: Any) -> float:
        given = Settings.preset_named("tiny").override(overrides)
        return stage_costs(given, plain.element_set, RATES, plain.pilot)[-1].seconds

    # 4 frames of 64 x 64 in crops of 32: 16 crops, 8 steps of 2, 3 epochs.
    assert seconds() == pytest.approx(24 * 0.1)
    assert seconds(**{"train.seconds": 1.5}) == 1.5
    assert math.isclose(seconds(**{"train.seconds": 0.0, "train.epochs": 300}), 240.0)


def test_nothing_compresses_to_nothing() -> None:
    import numpy as np

    assert compressed_share([]) == 1.0
    assert compressed_share([np.zeros((1000, 3), np.float32)]) < 0.01
