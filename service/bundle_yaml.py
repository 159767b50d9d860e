"""YAML in a bundle: Mitsuba's dictionary form, judged before anything of it is expanded.

An alias is one node that stands in many places; reading a scene writes it out each time. So the size of the
document is counted as if all aliases were written out, which a handful of lines can drive beyond all memory.
"""

import posixpath
from collections.abc import Iterator
from typing import Any

import yaml

from service.bundle_rules import MAX_FLOAT, BundleFiles, PluginUse, SceneLimits, check_plugin, check_text
from service.errors import BundleError, HostileBundleError

MAX_YAML_NBYTES = 1 << 20
MAX_NODES = 200_000  # with every alias written out
MAX_NESTING = 64
MAX_REFERENCES = 2000
_VALUES = {"rgb", "spectrum", "ref"}  # types of the dictionary form that are no plugins
_TRANSFORMS = {"to_world", "to_uv"}


def parse_yaml(files: BundleFiles, name: str) -> Any:
    """The document of a YAML file of the bundle.

    Raises:
        HostileBundleError: aliases that expand without bound, nesting deeper than any scene, tags of Python.
        BundleError: it is too large, no UTF-8 or no YAML.
    """
    where, path = f"file {name}", files.root / name
    nbytes = path.stat().st_size
    if nbytes > MAX_YAML_NBYTES:
        raise BundleError(where, f"must have at most {MAX_YAML_NBYTES} bytes", f"{nbytes}")
    try:
        text = path.read_bytes().decode("utf-8")
    except UnicodeDecodeError as error:
        raise BundleError(where, "must be UTF-8 text", f"{error.reason} at byte {error.start}") from None
    try:
        _check_size(text, where)
        return yaml.safe_load(text)
    except yaml.constructor.ConstructorError as error:
        raise HostileBundleError(where, "must only hold plain YAML values", str(error.problem)[:200]) from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f" at line {mark.line + 1}" if mark else ""
        raise BundleError(where, "must be valid YAML", f"{getattr(error, 'problem', error)}{place}") from None
    except (ValueError, TypeError, OverflowError) as error:
        if isinstance(error, BundleError):
            raise
        raise BundleError(where, "must only hold values that can be read", " ".join(str(error).split())) from None


def _check_size(text: str, where: str) -> None:
    """Counts nodes with aliases written out, from the parser's events: nothing is built yet."""
    anchored: dict[str, int] = {}
    open_nodes: list[tuple[str | None, int]] = []  # (anchor, nodes in it so far)
    open_anchors: set[str] = set()
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        size = 0
        if isinstance(event, yaml.CollectionStartEvent):
            open_nodes.append((event.anchor, 1))
            open_anchors |= {event.anchor} if event.anchor is not None else set()
            if len(open_nodes) > MAX_NESTING:
                raise HostileBundleError(where, f"must nest at most {MAX_NESTING} deep", "more")
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, size = open_nodes.pop()
            if anchor is not None:
                anchored[anchor] = size
                open_anchors.discard(anchor)
        elif isinstance(event, yaml.AliasEvent):
            assert event.anchor is not None  # otherwise it is no alias
            if event.anchor in open_anchors:
                raise HostileBundleError(where, "must not hold itself", f"the alias {event.anchor[:60]!a}")
            size = anchored.get(event.anchor, 1)
        elif isinstance(event, yaml.ScalarEvent):
            size = 1
            if event.anchor is not None:
                anchored[event.anchor] = 1
        if size and open_nodes:
            anchor, inside = open_nodes[-1]
            open_nodes[-1] = (anchor, inside + size)
        if size > MAX_NODES or (open_nodes and open_nodes[-1][1] > MAX_NODES):
            raise HostileBundleError(where, f"must hold at most {MAX_NODES} values, aliases written out", "more")


def check_yaml_scene(files: BundleFiles, name: str, document: dict[str, Any], limits: SceneLimits) -> None:
    """Judge a YAML scene as `parse_yaml` returned it.

    Raises:
        HostileBundleError: it reaches out of the bundle.
        BundleError: it is no scene that the loader could build.
    """
    where, scene = f"file {name}", document.get("scene")
    if not isinstance(scene, dict) or not scene:
        raise BundleError(where, "must have a mapping of plugins under scene", type(scene).__name__)
    for path, value in _values(document, "", where):
        if isinstance(value, int | float) and not abs(value) <= MAX_FLOAT:  # also where it is NaN
            raise BundleError(f"{where}, {path}", "must be finite numbers", f"{str(value)[:40]}")
    uses = list(_uses(scene, f"{where}, scene", "scene"))
    if sum(use.children.count("") for use in uses) > MAX_REFERENCES:  # Mitsuba follows them by recursion
        raise HostileBundleError(where, f"must hold at most {MAX_REFERENCES} references", "more")
    folder = posixpath.dirname(name)
    for use in uses:
        if use.name not in _VALUES and use.name != "scene":
            check_plugin(use, limits, files, [folder])


def _values(value: Any, path: str, where: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            if not isinstance(key, str):
                raise BundleError(f"{where}, {path}", "must only have keys that are text", ascii(key)[:80])
            yield from _values(inner, f"{path}.{key[:60]}".lstrip("."), where)
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from _values(inner, f"{path}[{index}]", where)
    else:
        yield path, value


def _uses(value: dict[str, Any], where: str, key: str) -> Iterator[PluginUse]:
    """Every plugin of the dictionary form, inner ones first."""
    plugin = value.get("type", "scene" if key == "scene" else None)
    if plugin == "scene" and key != "scene":
        raise BundleError(where, "must be the only scene", "a scene in a scene")
    if not isinstance(plugin, str) or not plugin:
        raise BundleError(where, "must have a type", ascii(plugin)[:80])
    use = PluginUse(f"{where}, type {plugin[:60]!a}", plugin)
    for name, inner in value.items():
        if isinstance(inner, dict) and name not in _TRANSFORMS:
            yield from _uses(inner, f"{where}.{ascii(name[:60])[1:-1]}", name)
            use.children.append("" if inner.get("type") == "ref" else str(inner.get("type")))
        elif isinstance(inner, str) and name not in ("type", "id"):
            use.texts[name] = inner
        elif isinstance(inner, int | float) and not isinstance(inner, bool):
            use.numbers[name] = float(inner)
    if plugin in _VALUES or plugin == "scene":
        for name, text in use.texts.items():
            check_text(name, text, where)
        if "filename" in use.texts:
            raise BundleError(where, "must hold its values in the YAML file", "a filename; write the values")
    yield use
