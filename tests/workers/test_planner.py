"""Plans of small scenes: what they choose, what they leave, and whether they say what a run does."""

import json
import math
from pathlib import Path
from typing import Any

import pytest

from storage.caches import CacheSet
from storage.store import Store
from tests.workers.planned_scenes import SKY, open_run, scene_file
from workers.audit import SceneAudit
from workers.bake import bake_refs, run_bake
from workers.element_stage import run_elements
from workers.plan_cost import Rates, compressed_share, stage_costs
from workers.plan_stage import FILE, plan_ref, planned_run
from workers.planner import GRIDS, decide, grid_for, sharpest_alpha
from workers.settings import Settings, SettingsError

ROUGH = {"type": "roughconductor", "alpha": 0.5}
RATES = Rates(elements_s=1.0, diffuse=1e6, directional=1e6, frames=1e6, step_s={(16, 16, 16): 0.1})


def choice(decision: Any, item: str) -> Any:
    return next(each for each in decision.choices if each.item == item)


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


def test_scene_without_glossy_materials_has_no_directions(tmp_path: Path) -> None:
    decision = decide(open_run(scene_file(tmp_path, light=SKY)))
    assert choice(decision, "directions").choice == choice(decision, "directional lobe").choice == "none"
    assert "cache.directional_spp" not in decision.overrides
    assert not decision.network_needed and "not needed" in choice(decision, "network").choice


def test_glossy_and_glass_balls_need_a_network(tmp_path: Path) -> None:
    for ball in (ROUGH, {"type": "dielectric"}):
        assert decide(open_run(scene_file(tmp_path, ball, light=SKY))).network_needed


def test_plan_repeats_itself_and_a_persons_setting_stays(tmp_path: Path) -> None:
    path = scene_file(tmp_path, ROUGH, light=SKY)
    free, again = (decide(open_run(path)) for _ in range(2))
    assert (free.overrides, free.choices) == (again.overrides, again.choices)
    assert "cache.directional_spp" in free.overrides, "else the next lines show nothing"
    kept = decide(open_run(path, **{"cache.directional_spp": 4}))
    assert "cache.directional_spp" not in kept.overrides
    said = choice(kept, "directional lobe")
    assert said.by == "you" and said.choice.startswith("4 ") and "set by you" in said.reason
    assert choice(free, "directional lobe").by == "plan"


def test_lower_goal_asks_for_more_paths_and_stays_within_twice_the_given(tmp_path: Path) -> None:
    path = scene_file(tmp_path, ROUGH, light=SKY)
    spp = [
        decide(open_run(path, **{"plan.noise": goal})).overrides.get("cache.directional_spp", 4)
        for goal in (0.5, 1e-4)
    ]  # fmt: skip
    assert spp == [1, 8]


def test_textured_roughness_counts_with_its_sharpest_texel(tmp_path: Path) -> None:
    alpha = {"type": "checkerboard", "color0": 0.05, "color1": 0.5}
    decision = decide(open_run(scene_file(tmp_path, {"type": "roughconductor", "alpha": alpha}, light=SKY)))
    assert sharpest_alpha(decision.audit) == pytest.approx(0.05)


def test_no_visible_material_is_as_rough_as_can_be() -> None:
    nothing = SceneAudit(materials=(), num_shapes=0, num_primitives=0, area=0.0, hit_share=0.0, channels={})
    assert sharpest_alpha(nothing) == 1.0


def test_planned_run_is_stored_read_again_and_marked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store.open(str(tmp_path / "store"), create=True)
    run = open_run(scene_file(tmp_path, ROUGH, light=SKY), store, **{"plan.mode": "adaptive"})
    planned = planned_run(run)
    assert planned.settings.plan.mode == "applied" and planned_run(planned) is planned
    kept = json.loads(store.read(plan_ref(run), FILE))
    assert kept["overrides"] and {row["item"] for row in kept["choices"]} >= {"directions", "network"}
    for key, value in kept["overrides"].items():
        section, name = key.split(".")
        assert planned.settings.to_json()[section][name] == value
    monkeypatch.setattr("workers.plan_stage.decide", None)  # a second plan would fail
    assert planned_run(run).settings == planned.settings
    preset = open_run(scene_file(tmp_path, ROUGH, light=SKY), store)
    assert planned_run(preset) is preset


def test_predicted_paths_and_bytes_are_those_of_the_bake(tmp_path: Path) -> None:
    store = Store.open(str(tmp_path / "store"), create=True)
    run = open_run(scene_file(tmp_path, ROUGH, light=SKY), store)
    decision = decide(run)
    costs = {cost.stage: cost for cost in stage_costs(run.settings, decision.element_set, RATES, decision.pilot)}
    elements = run_elements(run)
    run_bake(run, elements)
    cache = run.settings.cache
    assert costs["bake diffuse"].paths == elements.num_elements * cache.diffuse_spp
    directions = cache.azimuth * cache.polar * cache.directional_spp
    assert costs["bake directional"].paths == len(elements.glossy) * directions
    for lobe, ref in bake_refs(run, elements).items():
        assert costs[f"bake {lobe}"].nbytes == pytest.approx(CacheSet.open(store, ref).nbytes, rel=0.1), lobe


def test_time_of_training_is_limited_by_its_budget(tmp_path: Path) -> None:
    decision = decide(open_run(scene_file(tmp_path, light=SKY)))
    settings = Settings.preset_named("tiny")

    def seconds(**overrides: Any) -> float:
        given = settings.override(overrides)
        return stage_costs(given, decision.element_set, RATES, decision.pilot)[-1].seconds

    # 4 frames of 64 x 64 in crops of 32: 16 crops, 8 steps of 2, 3 epochs.
    assert seconds() == pytest.approx(24 * 0.1)
    assert seconds(**{"train.seconds": 1.5}) == 1.5
    assert math.isclose(seconds(**{"train.seconds": 0.0, "train.epochs": 300}), 240.0)


def test_nothing_compresses_to_nothing() -> None:
    import numpy as np

    assert compressed_share([]) == 1.0
    assert compressed_share([np.zeros((1000, 3), np.float32)]) < 0.01
