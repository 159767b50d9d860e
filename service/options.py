"""The command line's values as data: sizes, poses, settings, files that will be written."""

import math
import os
import re
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from service.errors import OptionError

if TYPE_CHECKING:
    from workers.camera import Camera


def parse_size(text: str, option: str = "--size") -> tuple[int, int]:
    """ "640x360" as (width, height) in pixels.

    Raises:
        OptionError: not two whole numbers of at least 1 with an x between them.
    """
    match = re.fullmatch(r"0*([1-9][0-9]{0,6})x0*([1-9][0-9]{0,6})", text.strip(), re.IGNORECASE)
    if match is None:
        raise OptionError(f"{option} must be WIDTHxHEIGHT in pixels such as 640x360, got {text!r}")
    return int(match[1]), int(match[2])


def parse_look_at(text: str) -> tuple[list[float], list[float], list[float]]:
    """ "ox,oy,oz,tx,ty,tz[,ux,uy,uz]" as origin, target and up; up is +Y when it is left out.

    Raises:
        OptionError: not 6 or 9 finite numbers.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (6, 9) or not all(math.isfinite(number) for number in numbers):
        raise OptionError(
            f"--look-at must be 9 numbers ox,oy,oz,tx,ty,tz,ux,uy,uz (origin, target, up), got {text!r}; "
            "write --look-at=... where the first one is negative"
        )
    return numbers[:3], numbers[3:6], numbers[6:] or [0.0, 1.0, 0.0]


def look_at_text(camera: "Camera") -> str:
    """A camera's pose as `parse_look_at` reads it, to six digits."""
    target = camera.origin + camera.forward
    return ",".join(f"{number + 0.0:.6g}" for vector in (camera.origin, target, camera.up) for number in vector)


def parse_overrides(assignments: list[str]) -> dict[str, str]:
    """["cache.diffuse_spp=256", ...] as a mapping; the settings check keys and values.

    Raises:
        OptionError: no "=" or no key, or one key given twice.
    """
    overrides: dict[str, str] = {}
    for assignment in assignments:
        key, separator, value = assignment.partition("=")
        if not separator or not key.strip():
            raise OptionError(f"--set must be key=value such as cache.diffuse_spp=256, got {assignment!r}")
        if key.strip() in overrides:
            raise OptionError(f"--set must give each key once, got {key.strip()!r} twice")
        overrides[key.strip()] = value.strip()
    return overrides


def check_writable(path: Path, option: str) -> None:
    """Fails before hours of work rather than after them.

    Raises:
        OptionError: the file's folder is missing or not writable, or the path is a folder.
    """
    folder = path.parent
    if path.is_dir():
        raise OptionError(f"{option} must name a file, got the folder {str(path)!r}")
    if not folder.is_dir():
        raise OptionError(f"{option} must lie in a folder that exists, got {str(path)!r}; create {str(folder)!r}")
    if not os.access(folder, os.W_OK):
        raise OptionError(f"{option} must lie in a folder that may be written, got {str(path)!r}")


def write_file(path: Path, content: bytes) -> None:
    """The whole file or none of it: written beside its name, then renamed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, partial = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".partial")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(partial, 0o666 & ~umask)  # mkstemp makes files that only their owner reads
        os.replace(partial, path)
    except BaseException:
        os.unlink(partial)
        raise
