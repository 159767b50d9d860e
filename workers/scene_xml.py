"""Mitsuba XML: the file's own scene, nothing added."""

import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from workers.backend import mi
from workers.scene_draft import SceneDraft, file_hash
from workers.scene_nodes import parse_state, resolve_files

_resolver_lock = threading.Lock()
_SPECTRUM_FILE = re.compile(r"<spectrum\b[^>]*\bfilename\s*=\s*[\"']([^\"']+)[\"']")


def read_xml(path: Path) -> SceneDraft:
    """Parse a Mitsuba XML scene with its includes.

    Raises:
        SceneError: broken XML, an undefined parameter or reference, a missing file.
    """
    what = f"scene {path.name}"
    with _search_folder(path.parent.resolve()):
        state = parse_state(lambda config: mi.parser.parse_file(config, str(path)), what)
    parsed = [Path(str(file)).resolve() for file in state.files]
    folders = list(dict.fromkeys([path.parent.resolve(), *(file.parent for file in parsed)]))
    content = [("xml", file_hash(file)) for file in parsed]
    files = resolve_files(state, folders, what) | _spectrum_files(parsed, folders)
    content += [(written, file_hash(file)) for written, file in sorted(files.items())]
    return SceneDraft(what=what, state=state, content=content)


@contextmanager
def _search_folder(folder: Path) -> Iterator[None]:
    """Let Mitsuba look into the scene's folder: the parser reads spectra while it parses."""
    mitsuba: Any = mi  # its stubs hide these functions
    with _resolver_lock:  # the resolver is the process's
        before = mitsuba.file_resolver()
        resolver = mitsuba.FileResolver(before)
        resolver.prepend(str(folder))
        mitsuba.set_file_resolver(resolver)
        try:
            yield
        finally:
            mitsuba.set_file_resolver(before)


def _spectrum_files(parsed: list[Path], folders: list[Path]) -> dict[str, Path]:
    """Spectra that the parser has read already: {name as written: path}."""
    names = [name for file in parsed for name in _SPECTRUM_FILE.findall(file.read_text(errors="replace"))]
    found = {name: next((folder / name for folder in folders if (folder / name).is_file()), None) for name in names}
    return {name: path for name, path in found.items() if path is not None}
