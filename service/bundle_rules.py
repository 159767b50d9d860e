"""What a scene in a bundle may ask for, whatever language it is written in.

`bundle_xml` and `bundle_yaml` turn their files into `PluginUse`s; the rules are here, once.
"""

import posixpath
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from service.bundle_assets import check_asset
from service.errors import BundleError, HostileBundleError
from service.schemas import MAX_SIDE_PX
from workers.scene_plugins import PLUGINS, plugin_refusal

MAX_FLOAT = 3.4e38  # of float32, in which Mitsuba computes
MAX_TEXT = 1 << 20  # characters of one value
FILM_PIXELS_OVER_FRAME = 4  # a job may ask for a smaller size than the file's own
PINHOLE_SENSORS = ("perspective", "thinlens")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:")
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")
_CAMEL = re.compile(r"(?<=[a-z])([A-Z]+)")
_NEED_FILE = {"bitmap", "envmap", "obj", "ply", "serialized", "gridvolume", "measured", "ellipsoidsmesh"}


@dataclass(frozen=True, kw_only=True)
class SceneLimits:
    """Numbers that a scene may not exceed.

    Attributes:
        max_pixels: of a frame; a film may have `FILM_PIXELS_OVER_FRAME` times as many.
        max_spp: samples a pixel of a sampler.
        max_depth: longest path in edges; -1, unlimited, is allowed.
    """

    max_pixels: int
    max_spp: int
    max_depth: int


@dataclass
class PluginUse:
    """One plugin of a scene with its own values.

    Attributes:
        where: what a message calls it: the file and the place in it.
        name: Mitsuba's name of the plugin.
        texts: values that are text.
        numbers: values that are one number.
        children: names of the plugins in it, in order; references count as "".
    """

    where: str
    name: str
    texts: dict[str, str] = field(default_factory=dict)
    numbers: dict[str, float] = field(default_factory=dict)
    children: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class BundleFiles:
    """The files of an unpacked bundle, by their paths with "/"."""

    root: Path
    names: frozenset[str]

    def confined(self, folder: str, written: str, where: str) -> str:
        """The path in the bundle that a name written in a file of `folder` means; it need not exist.

        Raises:
            HostileBundleError: it is absolute, a URL, or leads out of the bundle.
        """
        rule, shown = "must name a file inside the bundle", ascii(written[:200])
        if not written.strip() or _CONTROL.search(written):
            raise HostileBundleError(where, rule, f"{shown}")
        slashes = written.replace("\\", "/")
        if slashes.startswith(("/", "~")) or _SCHEME.match(slashes):
            raise HostileBundleError(where, rule, f"{shown}; use a relative path")
        path = posixpath.normpath(posixpath.join(folder, slashes))
        if path == ".." or path.startswith(("../", "/")):
            raise HostileBundleError(where, rule, f"{shown}; pack the file and correct the path")
        return path

    def require(self, folders: Iterable[str], written: str, where: str) -> str:
        """The first file of this name, looked for in each folder in turn as the loader does.

        Raises:
            HostileBundleError: the search leaves the bundle before a file is found.
            BundleError: there is none.
        """
        for folder in folders:
            path = self.confined(folder, written, where)
            if path in self.names and "\\" not in written:
                return path
        raise BundleError(where, "must name a file of the bundle", f"{written[:200]!a}; add it or correct it")

    def is_folder(self, path: str) -> bool:
        return path == "." or any(name.startswith(f"{path}/") for name in self.names)


def snake_case(name: str) -> str:
    """Property names of scenes before version 2 (maxDepth), as Mitsuba renames them."""
    return _CAMEL.sub(lambda match: "_" + match[1].lower(), name)


def parse_number(text: str, where: str) -> float:
    """One finite number.

    Raises:
        BundleError: it is none.
    """
    number = float(text) if len(text) <= 400 and _NUMBER.fullmatch(text) else float("nan")
    if not abs(number) <= MAX_FLOAT:  # also where it is NaN
        raise BundleError(where, "must be finite numbers", ascii(text[:80]))
    return number


def check_text(key: str, text: str, where: str) -> None:
    """Texts that are no file names cannot become any: Mitsuba looks for some of them (a conductor's material) in
    a folder of its own.

    Raises:
        HostileBundleError: the text could be a path.
    """
    if len(text) > MAX_TEXT:
        raise HostileBundleError(f"{where}, {key}", f"must have at most {MAX_TEXT} characters", f"{len(text)}")
    if set(text) & set("/\\") or ".." in text or _CONTROL.search(text):
        raise HostileBundleError(f"{where}, {key}", "must not look like a path", ascii(text[:80]))


def check_plugin(use: PluginUse, limits: SceneLimits, files: BundleFiles, folders: Iterable[str]) -> None:
    """Judge one plugin and its values.

    Raises:
        HostileBundleError: its name or a text is a path, or a file lies outside.
        BundleError: the plugin is not on the list, or asks for too much.
    """
    where = use.where
    if _SCHEME.match(use.name) or set(use.name) & set("./\\") or _CONTROL.search(use.name):
        raise HostileBundleError(where, "must name a Mitsuba plugin", ascii(use.name[:80]))
    refusal = plugin_refusal(use.name)
    if refusal is not None:
        raise BundleError(where, "must be a plugin of the allow-list", f"{use.name[:80]!a}: {refusal}")
    for key, text in use.texts.items():
        if key == "filename":
            check_asset(use.name, files.root / files.require(folders, text, where), where)
        else:
            check_text(key, text, where)
    # Without these, Mitsuba 3.9 does not complain, it crashes.
    if use.name in _NEED_FILE and "filename" not in use.texts:
        raise BundleError(where, f"must have a filename, as every {use.name}", "none")
    if use.name == "blendbsdf" and sum(child in PLUGINS["bsdf"] or not child for child in use.children) != 2:
        raise BundleError(where, "must hold two materials, as every blendbsdf", f"{len(use.children)} children")
    _check_limits(use, limits)


def _check_limits(use: PluginUse, limits: SceneLimits) -> None:
    numbers = {snake_case(key): value for key, value in use.numbers.items()}
    if use.name in PLUGINS["film"]:
        width, height = numbers.get("width", 768), numbers.get("height", 576)
        if not (1 <= width <= MAX_SIDE_PX and 1 <= height <= MAX_SIDE_PX):
            raise BundleError(use.where, f"must be 1 to {MAX_SIDE_PX} pixels wide and high", f"{width:g}x{height:g}")
        most = limits.max_pixels * FILM_PIXELS_OVER_FRAME
        if width * height > most:
            raise BundleError(use.where, f"must have at most {most} pixels", f"{width:g}x{height:g}")
    spp = numbers.get("sample_count", 1)
    if use.name in PLUGINS["sampler"] and not 1 <= spp <= limits.max_spp:
        raise BundleError(use.where, f"must take 1 to {limits.max_spp} samples a pixel", f"{spp:g}")
    depth = numbers.get("max_depth", -1)
    if use.name in PLUGINS["integrator"] and not (depth == -1 or 0 <= depth <= limits.max_depth):
        raise BundleError(use.where, f"must have a max_depth of -1 or 0 to {limits.max_depth}", f"{depth:g}")
