"""The list of plugins against the installed Mitsuba and the scene loader."""

from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.workers.plugin_scenes import OF_ONE_PIXEL, write_plugin_scene
from workers.errors import SceneError
from workers.scene import load_scene
from workers.scene_plugins import ALLOWED_PLUGINS, PLUGINS, REFUSED_PLUGINS, plugin_refusal

PACKAGE = Path(str(find_spec("mitsuba").origin)).parent  # type: ignore[union-attr]


def installed_plugins() -> set[str]:
    native = {path.stem for path in (PACKAGE / "plugins").glob("*.so")}
    python = {path.stem for path in (PACKAGE / "python" / "ad" / "integrators").glob("*.py")}
    return (native | python) - {"__init__", "common"}


def test_every_installed_plugin_is_allowed_or_refused_with_a_reason() -> None:
    assert installed_plugins() == ALLOWED_PLUGINS | REFUSED_PLUGINS.keys()
    assert not ALLOWED_PLUGINS & REFUSED_PLUGINS.keys()
    assert sum(map(len, PLUGINS.values())) == len(ALLOWED_PLUGINS)


def test_plugin_refusal_tells_why() -> None:
    assert plugin_refusal("diffuse") is None
    assert "addresses" in (plugin_refusal("blender") or "")
    assert "none of the Mitsuba plugins" in (plugin_refusal("../evil") or "")


@pytest.mark.parametrize(("tag", "name"), [(tag, name) for tag in PLUGINS for name in sorted(PLUGINS[tag])])
def test_the_loader_builds_every_allowed_plugin(tmp_path: Path, tag: str, name: str) -> None:
    path = write_plugin_scene(tmp_path, tag, name)
    assert f"type='{name}'" in path.read_text()
    edge_px = 1 if name in OF_ONE_PIXEL else 8
    load_scene(path, width=edge_px, height=edge_px)


@pytest.mark.parametrize("name", ["instance", "specfilm", "stokes"])
def test_the_loader_refuses_them_too(tmp_path: Path, name: str) -> None:
    scene = tmp_path / "scene.xml"
    bodies = {
        "specfilm": "<sensor type='perspective'><film type='specfilm'/></sensor>",
        "stokes": "<integrator type='stokes'/>",
    }
    body = bodies.get(name, f"<shape type='{name}'/>") + "<sensor type='perspective'/><emitter type='point'/>"
    scene.write_text(f"<scene version='3.0.0'>{body}<shape type='cube'/></scene>")
    with pytest.raises(SceneError):
        load_scene(scene, width=8, height=8)
