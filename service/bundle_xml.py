"""Mitsuba XML in a bundle, judged without Mitsuba.

The file is read as Mitsuba's own parser reads it (its tags, their attributes, <default> substitution in document
order, <include> with the same parameters), so that what is judged is what will be built. What that parser does
not know is refused here already.
"""

import posixpath
import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, field

from service.bundle_graph import check_references
from service.bundle_rules import BundleFiles, PluginUse, SceneLimits, check_plugin, parse_number, snake_case
from service.bundle_xml_text import MAX_ELEMENTS, parse_xml
from service.errors import BundleError, HostileBundleError
from workers.scene_plugins import PLUGINS

MAX_INCLUDE_DEPTH = 15  # Mitsuba's own
MAX_EXPANDED = 4 << 20  # characters that parameters may add, all together
OBJECT_TAGS = frozenset({*PLUGINS, "scene", "spectrum"})
_TRANSFORMS = {
    "translate": {"x", "y", "z", "value"}, "scale": {"x", "y", "z", "value"},
    "rotate": {"x", "y", "z", "value", "angle"}, "lookat": {"origin", "target", "up"}, "matrix": {"value"},
}  # fmt: skip
_ATTRIBUTES = {
    **{tag: {"name", "value"} for tag in ("boolean", "integer", "float", "string", "rgb", "default")},
    **{tag: {"name", "value", "x", "y", "z"} for tag in ("point", "vector")},
    "spectrum": {"name", "value", "filename"}, "transform": {"name"}, "ref": {"name", "id"},
    "include": {"filename", "name"}, "alias": {"id", "as"}, "path": {"value"},
}  # fmt: skip
_PARAMETER = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")
_VERSION = re.compile(r"\d{1,4}(\.\d{1,6}){2}")
_INTEGER = re.compile(r"\s*-?\d{1,18}\s*")


@dataclass
class _Document:
    """What is known of a scene while its files are walked, in the order of the parser."""

    parameters: dict[str, str] = field(default_factory=dict)
    folders: list[str] = field(default_factory=list)  # of the files walked so far: where file names are looked for
    included: set[str] = field(default_factory=set)
    ids: dict[str, int] = field(default_factory=dict)
    aliases: list[tuple[str, str, str]] = field(default_factory=list)  # (where, id, as)
    edges: list[list[int]] = field(default_factory=list)
    references: list[tuple[str, int, str]] = field(default_factory=list)  # (where, from node, id)
    uses: list[tuple[str, PluginUse]] = field(default_factory=list)  # (tag, plugin)
    num_elements: int = 0
    expanded: int = 0


def check_xml_scene(files: BundleFiles, name: str, limits: SceneLimits) -> set[str]:
    """Judge an XML scene with everything that it includes; returns the XML files that it includes.

    Raises:
        HostileBundleError: it reaches out of the bundle, or is built to exhaust its reader.
        BundleError: it is no scene that the loader could build.
    """
    document = _Document()
    _walk_file(document, files, name, parent=None, depth=0)
    for _, use in document.uses:
        check_plugin(use, limits, files, document.folders)
    check_references(f"file {name}", document.ids, document.aliases, document.references, document.edges)
    tags = [tag for tag, _ in document.uses]
    for tag, remedy in (("shape", "add geometry"), ("sensor", "add a perspective sensor"), ("emitter", "add a light")):
        if tag not in tags:
            raise BundleError(f"file {name}", f"must hold a {tag}", f"none; {remedy}")
    return document.included


def _walk_file(
    document: _Document,
    files: BundleFiles,
    name: str,
    parent: PluginUse | None,
    depth: int,
    parent_node: int = 0,
    parent_search: Sequence[str] = (),
) -> None:
    """`parent_search` are the folders of the file that includes this one: it looks there after its own."""
    if depth >= MAX_INCLUDE_DEPTH:
        raise HostileBundleError(f"file {name}", f"must be included at most {MAX_INCLUDE_DEPTH} deep", "more")
    folder = posixpath.dirname(name)
    if folder not in document.folders:
        document.folders.append(folder)
    root = parse_xml(files, name)
    where = f"file {name}, <{root.tag}>"
    if not _VERSION.fullmatch(root.get("version", "")):
        raise BundleError(where, "must have a version such as 3.0.0", ascii(root.get("version", "none")[:40]))
    walk = _Walk(document, files, name, [folder, *parent_search], depth)
    if root.tag == "scene" and parent is not None:  # its content joins that of the scene which includes it
        walk.check_attributes(root, {"version", "type", "id", "name"}, where)
        for child in root:
            walk.visit(child, parent, parent_node)
    else:
        walk.visit_object(root, parent, parent_node if parent is not None else None)


class _Walk:
    """One file's elements, in order."""

    def __init__(self, document: _Document, files: BundleFiles, name: str, search: list[str], depth: int) -> None:
        self.document, self.files, self.name, self.search, self.depth = document, files, name, search, depth

    def visit(self, element: ET.Element, parent: PluginUse, node: int) -> None:
        """An element inside the plugin `parent`, which is number `node`."""
        tag = element.tag
        if tag in OBJECT_TAGS and not (tag == "spectrum" and "type" not in element.attrib):
            self.visit_object(element, parent, node)
            return
        where = f"{parent.where}, <{ascii(tag)[1:-1]} name={element.get('name', '')[:60]!a}>"
        self.count(where)
        if tag not in _ATTRIBUTES:
            raise BundleError(where, "must be a tag of Mitsuba's scene format", "another")
        self.check_attributes(element, _ATTRIBUTES[tag], where)
        values = {key: self.substitute(value, where) for key, value in element.items()}
        if tag == "transform":
            self.visit_transform(element, where)
        elif len(element):
            raise BundleError(where, "must hold nothing", f"<{ascii(element[0].tag)[1:-1]}>")
        self.visit_property(tag, values, where, parent, node)

    def visit_object(self, element: ET.Element, parent: PluginUse | None, parent_node: int | None) -> None:
        where = f"file {self.name}, <{ascii(element.tag)[1:-1]}>"
        self.count(where)
        if element.tag not in OBJECT_TAGS:
            raise BundleError(where, "must be a tag of Mitsuba's scene format", "another")
        is_root = parent is None or "version" in element.attrib
        self.check_attributes(element, {"type", "id", "name", *(("version",) if is_root else ())}, where)
        values = {key: self.substitute(value, where) for key, value in element.items()}
        if element.tag != "scene" and not values.get("type"):
            raise BundleError(where, "must have a type", "none")
        if element.tag == "scene" and (parent is not None or values.get("type", "scene") != "scene"):
            raise BundleError(where, "must be the root", "another place or type")
        node = self.add_node(values.get("id"), parent_node, where)
        plugin = values.get("type", "scene")
        label = f" id={values['id'][:60]!a}" if values.get("id") else ""
        use = PluginUse(f"file {self.name}, <{element.tag} type={plugin[:60]!a}{label}>", plugin)
        if element.tag != "scene":
            self.document.uses.append((element.tag, use))
        if parent is not None:
            parent.children.append(plugin)
        for child in element:
            self.visit(child, use, node)

    def visit_transform(self, element: ET.Element, where: str) -> None:
        for step in element:
            inner = f"{where}, <{ascii(step.tag)[1:-1]}>"
            self.count(inner)
            if step.tag not in _TRANSFORMS or len(step):
                raise BundleError(inner, f"must be one of {', '.join(sorted(_TRANSFORMS))}", "another")
            self.check_attributes(step, _TRANSFORMS[step.tag], inner)
            for value in step.attrib.values():
                self.numbers(self.substitute(value, inner), inner)

    def visit_property(self, tag: str, values: dict[str, str], where: str, parent: PluginUse, node: int) -> None:
        key, value = values.get("name", ""), values.get("value", "")
        if tag == "integer" and not _INTEGER.fullmatch(value):
            raise BundleError(where, "must be a whole number", ascii(value[:80]))
        if tag in ("float", "integer"):
            parent.numbers[snake_case(key)] = parse_number(value.strip(), where)
        elif tag in ("rgb", "point", "vector"):
            self.numbers(" ".join(text for axis, text in values.items() if axis != "name"), where)
        elif tag == "boolean" and value.lower() not in ("true", "false"):
            raise BundleError(where, "must be true or false", ascii(value[:80]))
        elif tag == "string":
            parent.texts[snake_case(key)] = value
        elif tag == "spectrum":
            self.numbers(value.replace(":", " "), where)
            if "filename" in values:
                self.files.require(self.search, values["filename"], where)
        elif tag == "ref":
            self.document.references.append((where, node, values.get("id", "")))
            parent.children.append("")
        elif tag == "alias":
            self.document.aliases.append((where, values.get("id", ""), values.get("as", "")))
        elif tag == "default":
            self.define(key, value, where)
        elif tag == "path":
            path = self.files.confined(posixpath.dirname(self.name), value, where)
            if not self.files.is_folder(path):
                raise BundleError(where, "must name a folder of the bundle", ascii(value[:80]))
            self.search.insert(0, "" if path == "." else path)
        elif tag == "include":
            path = self.files.require(self.search, values.get("filename", ""), where)
            self.document.included.add(path)
            _walk_file(self.document, self.files, path, parent, self.depth + 1, node, self.search)

    def add_node(self, id_: str | None, parent_node: int | None, where: str) -> int:
        document = self.document
        node = len(document.edges)
        document.edges.append([])
        if parent_node is not None:
            document.edges[parent_node].append(node)
        if id_ and document.ids.setdefault(id_, node) != node:
            raise BundleError(where, "must have an id of its own", f"a second {id_[:60]!a}")
        return node

    def define(self, key: str, value: str, where: str) -> None:
        if not _PARAMETER.fullmatch(key):
            raise BundleError(where, "must have a name of letters, digits and _", ascii(key[:80]))
        self.document.parameters.setdefault(key, value)

    def substitute(self, value: str, where: str) -> str:
        """$name replaced as Mitsuba does: longest names first, each once over the whole text."""
        if "$" not in value:
            return value
        if "\\$" in value:
            raise BundleError(where, "must not hold an escaped $", ascii(value[:80]))
        for key in sorted(self.document.parameters, key=len, reverse=True):
            times = value.count(f"${key}")
            if times:
                self.document.expanded += times * len(self.document.parameters[key])
                if self.document.expanded > MAX_EXPANDED:
                    raise HostileBundleError(where, f"must not make parameters expand to over {MAX_EXPANDED}", "more")
                value = value.replace(f"${key}", self.document.parameters[key])
        if "$" in value:
            raise BundleError(where, "must only use parameters that a <default> defines before it", ascii(value[:80]))
        return value

    def count(self, where: str) -> None:
        self.document.num_elements += 1
        if self.document.num_elements > MAX_ELEMENTS:
            raise HostileBundleError(where, f"must be one of at most {MAX_ELEMENTS} elements", "more")

    def check_attributes(self, element: ET.Element, known: set[str], where: str) -> None:
        unknown = sorted(set(element.attrib) - known)
        if unknown:
            raise BundleError(where, f"must only have the attributes {', '.join(sorted(known))}",
                              ", ".join(ascii(key[:60]) for key in unknown))  # fmt: skip

    def numbers(self, text: str, where: str) -> None:
        for part in text.replace(",", " ").split():
            parse_number(part, where)
