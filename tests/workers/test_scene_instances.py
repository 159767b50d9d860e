"""Instances against the same shapes written by hand."""

from pathlib import Path

import numpy as np
import pytest

import workers.scene_instances
from tests.workers.test_scene_xml import LIGHT, sensor, write
from workers.backend import mi
from workers.errors import SceneError
from workers.scene import load_scene
from workers.scene_request import read_scene_request
from workers.surfaces import build_surface_table

MATERIAL = '<bsdf type="diffuse" id="m"><rgb name="reflectance" value="0.8,0.2,0.1"/></bsdf>'
BALL = """<shape type="sphere"><point name="center" x="0.2" y="0" z="0"/><float name="radius" value="0.5"/>{at}
<ref id="m"/></shape>"""
BOX = '<shape type="cube">{at}<ref id="m"/></shape>'
SMALL = '<scale value="0.4"/>'
PLACES = ('<rotate y="1" angle="30"/><translate x="-1"/>', '<scale value="1.5"/><translate x="1.2" y="0.3"/>')


def at(*steps: str) -> str:
    return f'<transform name="to_world">{"".join(steps)}</transform>'


def instanced(folder: Path) -> Path:
    group = f'<shape type="shapegroup" id="g">{BALL.format(at="")}{BOX.format(at=at(SMALL))}</shape>'
    uses = "".join(f'<shape type="instance"><ref id="g"/>{at(place)}</shape>' for place in PLACES)
    return write(folder, sensor(), MATERIAL, group, uses, LIGHT, name="instanced.xml")


def written_out(folder: Path) -> Path:
    shapes = "".join(BALL.format(at=at(place)) + BOX.format(at=at(SMALL, place)) for place in PLACES)
    return write(folder, sensor(), MATERIAL, shapes, LIGHT, name="written.xml")


def test_instances_render_as_the_shapes_written_out(tmp_path: Path) -> None:
    images = []
    for path in (instanced(tmp_path), written_out(tmp_path)):
        scene = load_scene(path)
        depth = mi.load_dict({"type": "aov", "aovs": "n:sh_normal,p:position"})
        images.append(
            np.array(mi.render(scene.mi_scene, sensor=scene.make_sensor(scene.camera), integrator=depth, spp=1))
        )
    assert np.abs(images[1]).max() > 0
    np.testing.assert_allclose(images[0], images[1], atol=1e-5)


def test_every_instance_is_shapes_of_its_own_and_noted(tmp_path: Path) -> None:
    scene = load_scene(instanced(tmp_path))
    ids = [shape.id() for shape in scene.mi_scene.shapes()]
    assert len(set(ids)) == len(ids) == 4
    assert any("2 instances were written out as 4 shapes" in note for note in scene.notes)
    assert build_surface_table(scene.mi_scene).num_prims == 2 * (1 + 12)
    assert read_scene_request(str(instanced(tmp_path))).width == 60


def test_more_copies_than_the_limit_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers.scene_instances, "MAX_EXPANDED_SHAPES", 3)
    with pytest.raises(SceneError, match="at most 3 shapes"):
        load_scene(instanced(tmp_path))
