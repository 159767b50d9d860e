"""What a scene's file asks for is what loading it would use."""

from pathlib import Path

import pytest

from workers.errors import SceneError
from workers.job_spec import JobSpec, JobSpecError
from workers.scene import load_scene
from workers.scene_request import read_scene_request


@pytest.mark.parametrize("source", ["tiny", "builtin:tabletop"])
def test_a_request_agrees_with_the_loaded_scene(source: str) -> None:
    request = read_scene_request(source)
    scene = load_scene(source)
    assert (request.name, request.width, request.height) == (scene.name, scene.camera.width, scene.camera.height)
    assert request.settings == dict(scene.settings)


def test_a_broken_scene_is_refused(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text("<scene version='3.0.0'></scene>")
    for source in (str(tmp_path / "scene.xml"), str(tmp_path / "none.xml"), "builtin:attic"):
        with pytest.raises(SceneError):
            read_scene_request(source)


@pytest.mark.parametrize("stages", [(), ("render",), ("bake", "train"), ("bake", "bake")])
def test_stages_are_the_first_of_the_pipeline(stages: tuple[str, ...]) -> None:
    with pytest.raises(JobSpecError, match="must be the first of bake, render, train, evaluate"):
        JobSpec(scene="tiny", settings={}, stages=stages)
