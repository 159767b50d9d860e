"""The list of plugins against the installed Mitsuba and the scene loader."""

from importlib.util import find_spec
from pathlib import Path

import pytest

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


BODIES = {
    "bsdf": "<shape type='cube'><bsdf type='{}'/></shape>",
    "emitter": "<emitter type='{}'/>",
    "shape": "<shape type='{}'/>",
    "sampler": "<sensor type='perspective'><sampler type='{}'/></sensor>",
    "rfilter": "<sensor type='perspective'><film type='hdrfilm'><rfilter type='{}'/></film></sensor>",
    "integrator": "<integrator type='{}'/>",
    "medium": "<shape type='cube'><medium type='{}' name='interior'/></shape>",
}
WITHOUT_VALUES = {  # those that need none
    "bsdf": "circular conductor dielectric diffuse hair null plastic polarizer pplastic principled principledthin "
    "retarder roughconductor roughdielectric roughplastic thindielectric",
    "emitter": "constant directional point spot sunsky timed_sunsky",
    "shape": "cube cylinder disk rectangle sphere",
    "sampler": " ".join(sorted(PLUGINS["sampler"])),
    "rfilter": " ".join(sorted(PLUGINS["rfilter"])),
    "integrator": "depth direct moment path prb ptracer volpath volpathmis",
    "medium": " ".join(sorted(PLUGINS["medium"])),
}
CASES = [(kind, name) for kind, names in WITHOUT_VALUES.items() for name in names.split()]


@pytest.mark.parametrize(("kind", "name"), CASES)
def test_the_loader_builds_allowed_plugins(tmp_path: Path, kind: str, name: str) -> None:
    body = BODIES[kind].format(name)
    sensor = "" if "<sensor" in body else "<sensor type='perspective'/>"
    light = "<emitter type='point'/>" if kind != "emitter" else ""
    scene = tmp_path / "scene.xml"
    scene.write_text(f"<scene version='3.0.0'>{sensor}{light}<shape type='rectangle'/>{body}</scene>")
    assert name in ALLOWED_PLUGINS
    load_scene(scene, width=8, height=8)


@pytest.mark.parametrize("name", ["instance", "shapegroup", "specfilm", "stokes"])
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
