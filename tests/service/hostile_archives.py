# ruff: noqa: E501  # tables are read by the row
"""Archives that must be refused for their entries, whatever is in them."""

import struct
import warnings
from collections.abc import Callable, Iterator

from tests.service.bundle_packing import TRIANGLE, Hostile, info_of, pack, pack_infos, png, xml


def bad_names() -> Iterator[Hostile]:
    inside = {
        "parent": "../scene.xml", "deep-parent": "a/b/../../../x", "middle": "a/../b.png", "dots-only": "..",
        "dot": "./a.png", "dot-middle": "a/./b.png", "empty-segment": "a//b.png", "trailing-parent": "a/..",
        "backslash": "a\\b.png", "backslash-parent": "..\\..\\x", "backslash-root": "\\x",
        "fullwidth-dots": "\uff0e\uff0e/x", "two-dot-leader": "\u2025/x", "fullwidth-slash": "a\uff0fb",
        "fullwidth-backslash": "a\uff3cb",
    }  # fmt: skip
    absolute = {"root": "/etc/passwd", "double": "//host/share", "root-scene": "/scene.xml"}
    drives = {"c": "C:/x.png", "c-relative": "C:x.png", "lower": "d:/x", "inner": "a/c:/x", "fullwidth": "\uff23:/x"}
    devices = {name: f"a/{name}" for name in ("CON", "nul", "aux.png", "COM1", "lpt9.txt", "PRN", "com\u00b9.obj")}
    invisible = {
        "nul": "a\x00b", "newline": "a\nb", "escape": "a\x1b[31m", "rtl": "a\u202egnp.exe", "zero-width": "a\u200bb",
        "bom": "\ufeffa", "isolate": "a\u2066b", "soft-hyphen": "a\u00adb", "private": "a\ue000b", "delete": "a\x7fb",
        "line-separator": "a\u2028b", "unassigned": "a\U000e0fffb",
    }  # fmt: skip
    edges = {"trailing-space": "a /b", "leading-space": " a", "trailing-dot": "a./b", "long-segment": "x" * 201,
             "long": "/".join(["y" * 150] * 8), "deep": "/".join("z" * 20), "only-slash": "/"}  # fmt: skip
    groups = [(inside, "stay inside|look-alikes|folders by"), (absolute, "relative path"), (drives, "drive"),
              (devices, "device"), (invisible, "visible"), (edges, "space|bytes|deep|name of")]  # fmt: skip
    for names, words in groups:
        for label, name in names.items():
            yield Hostile(
                f"name-{label}-{ascii(name)[1:13]}", lambda name=name: pack_infos((info_of(name), b"x")), words
            )


def bad_entries() -> Iterator[Hostile]:
    kinds = {"symlink": 0o120777, "character-device": 0o020666, "block-device": 0o060666, "fifo": 0o010644,
             "socket": 0o140777, "unknown": 0o150000}  # fmt: skip
    for label, mode in kinds.items():
        for system in (0, 3):
            info = info_of("a.png", external_attr=mode << 16, create_system=system)
            yield Hostile(f"{label}-{system}", lambda info=info: pack_infos((info, b"/etc/passwd")), "link|special")
    for label, info, content in (
        ("folder-by-mode", info_of("a.png", external_attr=0o040755 << 16), b""),
        ("folder-by-dos-flag", info_of("a.png", external_attr=0x10), b""),
        ("folder-with-data", info_of("a/", external_attr=0o040755 << 16), b"data"),
        ("folder-as-file", info_of("a/"), b""),
    ):
        yield Hostile(label, lambda info=info, content=content: pack_infos((info, content)), "file or folder")
    pairs = {
        "same": ("a.png", "a.png"), "case": ("a.png", "A.PNG"), "sharp-s": ("stra\u00dfe", "STRASSE"),
        "accent-forms": ("\u00e9.png", "e\u0301.png"), "ligature": ("\ufb01.png", "fi.png"), "scene": ("x", "Scene.xml"),
        "fullwidth": ("\uff41.png", "a.png"), "kelvin": ("\u212a.png", "k.png"), "folder-case": ("T/a.png", "t/a.png"),
        "file-and-folder": ("a", "a/b"), "folder-and-file": ("a/b", "a"), "folder-entry-and-file": ("a/", "a"),
        "file-and-folder-case": ("A", "a/b"), "turkish": ("\u0130.png", "i\u0307.png"),
    }  # fmt: skip
    for label, (first, second) in pairs.items():
        folder = {"external_attr": 0o040755 << 16} if first.endswith("/") else {}
        infos = (info_of(first, **folder), b""), (info_of(second), b"2")
        yield Hostile(
            f"collision-{label}", lambda infos=infos: _quiet(lambda: pack_infos(*infos)), "name of its own|folder"
        )


def _quiet(make: Callable[[], bytes]) -> bytes:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # zipfile warns of duplicate names
        return make()


def patched(field: int, form: str, value: int, local: int | None = None) -> bytes:
    """A good zip with one number of its first directory record (and its local header) overwritten."""
    data = bytearray(pack({"a.png": b"picture" * 9, "scene.xml": xml("")}))
    record = data.index(b"PK\x01\x02")
    struct.pack_into(form, data, record + field, value)
    if local is not None:
        struct.pack_into(form, data, local, value)
    return bytes(data)


def overlapping() -> bytes:
    """Two directory records of one packed entry."""
    data = pack({"a.png": b"picture" * 9, "b.png": b"picture" * 9, "scene.xml": xml("")}).replace(b"b.png", b"a.png", 1)
    data = bytearray(data)
    struct.pack_into("<I", data, data.index(b"PK\x01\x02", data.index(b"PK\x01\x02") + 4) + 42, 0)
    return bytes(data)


def end_patched(field: int, form: str, value: int) -> bytes:
    data = bytearray(pack({"scene.xml": xml("")}))
    struct.pack_into(form, data, data.rindex(b"PK\x05\x06") + field, value)
    return bytes(data)


def bad_archives() -> Iterator[Hostile]:
    good = pack({"scene.xml": xml(""), "a.obj": TRIANGLE * 50})
    for label, data in (("empty", b""), ("text", b"not a zip"), ("gzip", b"\x1f\x8b\x08" + bytes(50)), ("rar", b"Rar!\x1a\x07"),
                        ("7z", b"7z\xbc\xaf\x27\x1c" + bytes(40)), ("tar", bytes(1024)), ("end-only", good[-22:]),
                        ("no-entries", pack({})), ("magic-only", b"PK\x03\x04")):  # fmt: skip
        yield Hostile(f"archive-{label}", lambda data=data: data, "zip archive|hold a scene|whole")
    for share in range(1, 20):
        yield Hostile(f"truncated-{share}", lambda share=share: good[: len(good) * share // 20], "zip archive")
    for label, flags in (("encrypted", 1), ("strong", 0x41), ("masked", 0x2001)):
        yield Hostile(f"{label}-entry", lambda flags=flags: patched(8, "<H", flags, 6), "encrypted")
    for method in (1, 6, 9, 12, 14, 93, 95, 98, 99):
        yield Hostile(f"method-{method}", lambda method=method: patched(10, "<H", method, 8), "stored or deflated")
    for label, make, words in (
        ("wrong-crc", lambda: patched(16, "<I", 12345, 14), "whole"),
        ("patch-data", lambda: patched(8, "<H", 0x20, 6), "whole"),
        ("other-volume", lambda: patched(34, "<H", 3), "volume"),
        ("future-version", lambda: patched(6, "<H", 255), "zip archive"),
        ("bad-offset", lambda: patched(42, "<I", 1 << 30), "whole|zip archive"),
        ("offset-of-other", lambda: patched(42, "<I", 60), "whole"),
        ("short-size", lambda: patched(24, "<I", 3), "whole"),
        ("declared-petabytes", lambda: patched(24, "<I", 0xFFFFFFF0), "unpack to at most"),
        ("compressed-beyond-end", lambda: patched(20, "<I", 1 << 20), "whole|zip archive"),
        ("directory-too-large", lambda: end_patched(12, "<I", 1 << 29), "directory|zip archive"),
        ("directory-offset", lambda: end_patched(16, "<I", 1 << 30), "zip archive|whole"),
        ("overlapping", overlapping, "bytes of its own"),
        ("local-name-differs", lambda: good.replace(b"a.obj", b"b.obj", 1), "whole"),
        ("garbled-directory", lambda: good.replace(b"PK\x01\x02", b"PK\x09\x09"), "zip archive"),
        ("garbled-data", lambda: good[:60] + bytes(40) + good[100:], "whole"),
        ("zeros", lambda: pack({"scene.xml": xml(""), "a.bin": bytes(8 << 20)}), "times its"),
        ("many-zeros", lambda: pack({"scene.xml": xml(""), **{f"{k}.bin": bytes(1 << 18) for k in range(40)}}), "times its"),
        ("many-files", lambda: pack({"scene.xml": xml(""), **{f"{k}": b"" for k in range(300)}}), "at most 256 files"),
        ("many-folders", lambda: pack({"scene.xml": xml(""), **{f"{k}/": b"" for k in range(300)}}), "at most 256 files"),
        ("zip-in-zip", lambda: pack({"scene.zip": pack({"scene.xml": xml("")})}), "hold a scene"),
        ("zip-named-scene", lambda: pack({"scene.xml": pack({"scene.xml": xml("")})}), "hold a scene"),
        ("only-hidden", lambda: pack({".scene.xml": xml(""), "__MACOSX/scene.xml": xml("")}), "hold a scene"),
        ("no-scene", lambda: pack({"readme.md": b"hello", "a.png": png(2, 2)}), "hold a scene"),
    ):  # fmt: skip
        yield Hostile(label, make, words)
