"""The pilot's noise against closed forms, and its robustness."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.workers.planned_scenes import SKY, open_run, scene_file
from workers.pilot import LobeNoise, Pilot, _weighted_quantile, ladder, run_pilot
from workers.planner import decide
from workers.run_state import RunState

UP = {"rotate": {"axis": [1, 0, 0], "angle": 90}}
BALL = {"type": "roughconductor", "alpha": 0.3}


def pilot_of(run: RunState, seed: int = 7) -> Pilot:
    decision = decide(run)
    hits = np.ones(decision.element_set.num_elements, np.int64)
    return run_pilot(run.scene.mi_scene, run.table, decision.element_set, hits, run.settings.cache,
                     run.scene.max_depth, seed)  # fmt: skip


def suns(*irradiances: float) -> dict[str, Any]:
    return {f"sun{i}": {"type": "directional", "direction": [0, -1, 0], "irradiance": value}
            for i, value in enumerate(irradiances)}  # fmt: skip


def test_one_sun_has_no_variance_and_takes_the_fewest_paths(tmp_path: Path) -> None:
    run = open_run(scene_file(tmp_path, shapes=suns(3.0)))
    decision = decide(run)
    assert decision.pilot.diffuse is not None
    assert decision.pilot.diffuse.relative_variance < 1e-5, "but for rounding in the mean of squares"
    assert decision.pilot.directional is None and decision.pilot.interpolation_error < 1e-3
    assert not decision.network_needed


def test_two_suns_have_the_variance_of_a_coin(tmp_path: Path) -> None:
    # One of two lights is picked, a and b, and counts twice: mean a + b, variance (a - b)^2.
    pilot = pilot_of(open_run(scene_file(tmp_path, shapes=suns(3.0, 1.0))))
    assert pilot.diffuse is not None
    assert pilot.diffuse.relative_variance == pytest.approx((2.0 / 4.0) ** 2, rel=0.02)


def test_constant_sky_has_the_variance_of_its_two_techniques(tmp_path: Path) -> None:
    """D = L exactly. With c the cosine and w the power heuristic's weight, a light sample (uniform over the sphere)
    is 4 L c (1 - w), a lobe sample (cosine-weighted, so c^2 is uniform) L w, w = 16 c^2 / (1 + 16 c^2)."""
    pilot = pilot_of(open_run(scene_file(tmp_path, light=SKY)))
    c = (np.arange(100_000) + 0.5) / 100_000
    light = 4 * c / (1 + 16 * c**2)
    by_light = np.mean(light**2) / 2 - (np.mean(light) / 2) ** 2  # half of the sphere is below the floor
    lobe = 16 * c / (1 + 16 * c)  # c here is the squared cosine
    expected = by_light + lobe.var()
    assert pilot.diffuse is not None
    assert pilot.diffuse.relative_variance == pytest.approx(expected, rel=0.05)
    assert pilot.display_power == pytest.approx(1.0, abs=0.05) and pilot.interpolation_error < 0.02


def test_black_scene_asks_for_the_fewest_paths(tmp_path: Path) -> None:
    dark = {"type": "constant", "radiance": 0.0}
    decision = decide(open_run(scene_file(tmp_path, BALL, light=dark)))
    pilot = decision.pilot
    assert pilot.diffuse is not None and pilot.directional is not None
    assert pilot.diffuse.relative_variance == pilot.directional.relative_variance == pilot.display_power == 0.0
    assert decision.overrides["cache.directional_spp"] == 1


def test_glossy_ball_has_noise_and_the_pilot_repeats_itself(tmp_path: Path) -> None:
    run = open_run(scene_file(tmp_path, BALL, light=SKY))
    one, again, other = (pilot_of(run, seed) for seed in (7, 7, 8))
    assert one.directional is not None and one.directional.relative_variance > 0
    strip = {"samples": {}}
    assert dataclasses.replace(one, **strip) == dataclasses.replace(again, **strip)
    assert dataclasses.replace(one, **strip) != dataclasses.replace(other, **strip)


def test_firefly_is_one_elements_luck(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = open_run(scene_file(tmp_path, light=SKY))
    calm = pilot_of(run)
    from workers import pilot as module

    kernel = module.bake_diffuse

    def with_firefly(*args: Any) -> tuple[np.ndarray, np.ndarray]:
        mean, square = (value.copy() for value in kernel(*args))
        square[3] += 1e8**2 / 256
        mean[3] += 1e8 / 256
        return mean, square

    monkeypatch.setattr(module, "bake_diffuse", with_firefly)
    shaken = pilot_of(run)
    assert calm.diffuse is not None and shaken.diffuse is not None
    assert shaken.diffuse.relative_variance < 2 * calm.diffuse.relative_variance


@pytest.mark.parametrize(
    ("paths", "spp"), [(0.0, 8), (1.0, 8), (8.0, 8), (8.1, 16), (1000.0, 1024), (1024.0, 1024), (math.inf, 4096)]
)
def test_ladder_is_the_next_power_of_two_within_bounds(paths: float, spp: int) -> None:
    assert ladder(min(paths, 1e30), 8, 4096) == spp


def test_paths_leave_the_error_that_was_asked_for() -> None:
    noise = LobeNoise(relative_variance=0.9, num_elements=10, share=1.0)
    assert noise.standard_error(noise.paths_for(0.04, 24.0), 24.0) == pytest.approx(0.04)


def test_weighted_quantile_of_equal_weights_is_the_ordered_value() -> None:
    values = np.array([5.0, 1.0, 3.0, 2.0, 4.0])
    assert _weighted_quantile(values, np.ones(5), 0.8) == 4.0
    assert _weighted_quantile(values, np.array([0.0, 1, 0, 0, 0]), 0.99) == 1.0
