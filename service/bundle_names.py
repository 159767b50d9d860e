"""Names of the files in a bundle: plain relative paths that mean the same on every system and to every eye."""

import re
import unicodedata

from service.errors import HostileBundleError

MAX_DEPTH = 16
MAX_SEGMENT_NBYTES = 200  # file systems allow 255; a temporary name needs the rest
MAX_NAME_NBYTES = 1024
_DRIVE = re.compile(r"[A-Za-z]:")
_DEVICE = re.compile(r"(con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³])(\..*)?", re.IGNORECASE)
_INVISIBLE = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}  # Unicode categories: control, format, surrogate, ...
_SYSTEM_FILES = {"__macosx", "thumbs.db", "desktop.ini"}


def check_name(name: str) -> str:
    """A file's or folder's path inside a bundle, without the final "/" of a folder.

    Raises:
        HostileBundleError: it is empty, absolute, leaves the bundle, or is not what it looks like.
    """
    shown = ascii(name[:200])
    path = name.removesuffix("/")
    if not path or len(_encoded(path, shown)) > MAX_NAME_NBYTES:
        raise HostileBundleError(f"entry {shown}", f"must have a name of 1 to {MAX_NAME_NBYTES} bytes", "another")
    if path.startswith("/"):
        raise HostileBundleError(f"entry {shown}", "must be a relative path", "an absolute path")
    if "\\" in path:
        raise HostileBundleError(f"entry {shown}", 'must separate folders by "/"', "a backslash")
    for letter in path:
        if unicodedata.category(letter) in _INVISIBLE:
            raise HostileBundleError(f"entry {shown}", "must be visible text", f"U+{ord(letter):04X}")
    segments = path.split("/")
    if len(segments) > MAX_DEPTH:
        raise HostileBundleError(f"entry {shown}", f"must lie at most {MAX_DEPTH} folders deep", f"{len(segments)}")
    for segment in segments:
        _check_segment(segment, shown)
    return path


def _encoded(text: str, shown: str) -> bytes:
    try:
        return text.encode("utf-8")
    except UnicodeEncodeError:
        raise HostileBundleError(f"entry {shown}", "must be Unicode text", "lone surrogates") from None


def _check_segment(segment: str, shown: str) -> None:
    entry = f"entry {shown}"
    folded = unicodedata.normalize("NFKC", segment)
    if segment in ("", ".", ".."):
        raise HostileBundleError(entry, "must stay inside the bundle", f"the folder {segment!r}")
    if folded in (".", "..") or set(folded) & set("/\\") - set(segment):
        raise HostileBundleError(entry, "must not hold look-alikes of a path", ascii(segment))
    if _DRIVE.match(folded):
        raise HostileBundleError(entry, "must not name a drive", ascii(segment))
    if _DEVICE.fullmatch(folded):
        raise HostileBundleError(entry, "must not name a device", ascii(segment))
    if segment != segment.strip(" ") or segment.endswith("."):
        raise HostileBundleError(entry, "must not start or end with a space, or end with a dot", ascii(segment))
    if len(segment.encode("utf-8")) > MAX_SEGMENT_NBYTES:
        raise HostileBundleError(entry, f"must have names of at most {MAX_SEGMENT_NBYTES} bytes", ascii(segment[:40]))


def folded_name(path: str) -> str:
    """Equal for names that a file system that ignores case or normalises Unicode takes for one."""
    return unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", path).casefold())


def is_system_file(path: str) -> bool:
    """Whether a name is what operating systems and editors leave beside one's files."""
    segments = path.split("/")
    return any(segment.startswith(".") or segment.lower() in _SYSTEM_FILES for segment in segments)
