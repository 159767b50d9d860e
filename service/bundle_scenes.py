"""Which files of a bundle are scenes, and whether they may be loaded."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import PurePosixPath

from service.bundle_mesh import check_mesh_scene, check_obj
from service.bundle_rules import BundleFiles, SceneLimits
from service.bundle_xml import check_xml_scene
from service.bundle_xml_text import parse_xml
from service.bundle_yaml import check_yaml_scene, parse_yaml
from service.errors import BundleError, HostileBundleError

YAML_SUFFIXES = (".yaml", ".yml")
MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
SCENE_SUFFIXES = (".xml", *YAML_SUFFIXES, *MESH_SUFFIXES)


@dataclass
class SceneFiles:
    """The scenes of a bundle.

    Attributes:
        scenes: paths of the files that may be loaded; the one that a bundle's name alone means comes first.
        notes: why the others were left out.
    """

    scenes: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def find_scenes(files: BundleFiles, limits: SceneLimits) -> SceneFiles:
    """Look at every file that could be a scene or belong to one.

    What reaches out of the bundle condemns all of it. A file that is merely no scene that we load (another
    version's, another program's) is left out with a note, as long as there is another one. Meshes are scenes
    only where there is no XML or YAML scene that could be made of them.

    Raises:
        HostileBundleError: something is hostile.
        BundleError: there is no scene that may be loaded.
    """
    named = {suffix: [name for name in sorted(files.names) if _suffix(name) == suffix] for suffix in SCENE_SUFFIXES}
    found = SceneFiles()
    refused: dict[str, BundleError] = {}
    _find_xml(named[".xml"], files, limits, found, refused)
    _find_yaml([name for suffix in YAML_SUFFIXES for name in named[suffix]], files, limits, found, refused)
    if found.scenes or refused:
        for name in named[".obj"]:
            check_obj(files, name, with_materials=False)
    else:
        for name in (name for suffix in MESH_SUFFIXES for name in named[suffix]):
            _collect(name, partial(check_mesh_scene, files, name), found, refused)
    if not found.scenes:
        for name in _in_order(list(refused)):
            raise refused[name]
        raise BundleError(
            "bundle", f"must hold a scene ({', '.join(SCENE_SUFFIXES)})", f"{len(files.names)} other files"
        )
    found.scenes = _in_order(found.scenes)
    found.notes += [f"{name}: not offered as a scene: {refused[name]}" for name in _in_order(list(refused))]
    return found


def _find_xml(names: list[str], files: BundleFiles, limits: SceneLimits, found: SceneFiles,
              refused: dict[str, BundleError]) -> None:  # fmt: skip
    included: set[str] = set()
    for name in names:
        _collect(name, partial(_check_one_xml, files, name, limits, included), found, refused)
    found.scenes = [name for name in found.scenes if name not in included]
    for name in included:
        refused.pop(name, None)


def _check_one_xml(files: BundleFiles, name: str, limits: SceneLimits, included: set[str]) -> None:
    tag = parse_xml(files, name).tag
    if tag != "scene":
        raise BundleError(f"file {name}", "must have a <scene> at its root", f"<{ascii(tag)[1:-1]}>")
    included |= check_xml_scene(files, name, limits)


def _find_yaml(names: list[str], files: BundleFiles, limits: SceneLimits, found: SceneFiles,
               refused: dict[str, BundleError]) -> None:  # fmt: skip
    def check(name: str) -> None:
        document = parse_yaml(files, name)
        if not isinstance(document, dict) or "scene" not in document:
            raise BundleError(f"file {name}", "must have a scene at its root", type(document).__name__)
        check_yaml_scene(files, name, document, limits)

    for name in names:
        _collect(name, partial(check, name), found, refused)


def _collect(name: str, check: Callable[[], None], found: SceneFiles, refused: dict[str, BundleError]) -> None:
    try:
        check()
    except HostileBundleError:
        raise
    except BundleError as error:
        refused[name] = error
    else:
        found.scenes.append(name)


def _suffix(name: str) -> str:
    return PurePosixPath(name).suffix.lower()


def _in_order(names: list[str]) -> list[str]:
    """Near the root first, `scene.*` before others."""
    return sorted(names, key=lambda name: (name.count("/"), PurePosixPath(name).stem.lower() != "scene", name))
