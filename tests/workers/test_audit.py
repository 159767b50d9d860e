"""The audit of small scenes against what they were made of."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.workers.planned_scenes import DIFFUSE, SKY, open_run, scene_file
from workers.audit import SceneAudit, audit_elements, audit_scene
from workers.camera_path import domain_poses
from workers.domain_census import element_hits
from workers.elements import build_elements
from workers.progress import Progress
from workers.run_state import PATH_SEED, RunState
from workers.visibility import domain_hits

RAYS = 48 * 48


def audited(run: RunState) -> SceneAudit:
    poses = domain_poses(run.paths, 4, PATH_SEED)
    return audit_scene(run.scene.mi_scene, run.table, poses, RAYS)


def test_floor_fills_the_view_and_its_channels_are_constant(tmp_path: Path) -> None:
    audit = audited(open_run(scene_file(tmp_path, light=SKY)))
    (floor,) = audit.materials
    assert floor.area == pytest.approx(256.0, rel=1e-5) and floor.num_primitives == 2
    assert (floor.visibility, audit.hit_share) == (1.0, 1.0)
    varies = {name: spread.varies for name, spread in audit.channels.items() if spread}
    assert varies == {"normal": False, "albedo": False, "distance": True}
    np.testing.assert_allclose(audit.channels["albedo"].mean, 0.5, rtol=1e-5)  # type: ignore[union-attr]
    json.dumps(audit.to_json(), allow_nan=False)


def test_textured_floor_varies_in_albedo(tmp_path: Path) -> None:
    checks = {"type": "diffuse", "reflectance": {"type": "checkerboard", "to_uv": [{"scale": 8}]}}
    audit = audited(open_run(scene_file(tmp_path, light=SKY, floor=checks)))
    assert audit.materials[0].facts.textured == ("reflectance",)
    assert audit.channels["albedo"].varies  # type: ignore[union-attr]
    # Checks of 0.4 and 0.2, half of the view each: a deviation of 0.1 in each of three channels.
    assert audit.materials[0].albedo_deviation == pytest.approx(0.1 * np.sqrt(3), rel=0.1)


def test_ball_of_glass_is_delta_and_takes_its_share_of_the_view(tmp_path: Path) -> None:
    audit = audited(open_run(scene_file(tmp_path, {"type": "dielectric"}, light=SKY)))
    glass = next(m for m in audit.materials if "delta" in m.facts.kinds)
    assert glass.facts.kinds == ("delta", "transmissive") and glass.area == pytest.approx(np.pi, rel=1e-4)
    assert audit.share("delta") == glass.visibility and 0.02 < glass.visibility < 0.4
    assert sum(m.visibility for m in audit.materials) == pytest.approx(1.0)


def test_emitter_and_two_sided_material_are_told(tmp_path: Path) -> None:
    lamp = {"type": "sphere", "center": [0.5, 0.5, 0], "radius": 0.2,
            "emitter": {"type": "area", "radiance": 4.0}}  # fmt: skip
    audit = audited(open_run(scene_file(tmp_path, {"type": "twosided", "bsdf": DIFFUSE}, shapes={"lamp": lamp})))
    assert {m.facts.two_sided for m in audit.materials} == {True, False}
    assert any("emissive" in m.facts.kinds and m.visibility > 0 for m in audit.materials)


def test_elements_answer_all_hits(tmp_path: Path) -> None:
    run = open_run(scene_file(tmp_path, {"type": "roughconductor", "alpha": 0.3}, light=SKY))
    poses = domain_poses(run.paths, 4, PATH_SEED)
    hits = domain_hits(run.scene.mi_scene, run.table, poses, 48, RAYS, Progress())
    elements = build_elements(run.table, hits, run.settings.cache)
    counts = element_hits(elements, hits)
    assert counts.sum() == len(hits.prim), "every hit was placed, so every hit has an element"
    summary = audit_elements(run.table, elements, counts)
    assert summary.num_elements == elements.num_elements and 0 < summary.num_directional < summary.num_elements
    ball = run.table.is_parametric[np.searchsorted(run.table.prim_offset, hits.prim, side="right") - 1]
    assert summary.share_directional == pytest.approx(ball.mean(), abs=1e-12)
