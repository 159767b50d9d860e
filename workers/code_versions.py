"""The versions of the code that decide which units a run looks for. A finished run says with which it was made."""

from typing import Any

from workers.cache_filter import FILTER_VERSION
from workers.elements import ELEMENTS_VERSION
from workers.errors import VersionError
from workers.run_state import SCHEMA_VERSION
from workers.scene import DIGEST_VERSION

ENTRY = "code_versions"
# Of the code that published runs before it said so.
_UNRECORDED = {"scene": 1, "schema": 1, "elements": 2, "filter": 2}


def code_versions() -> dict[str, int]:
    """Versions of this code by what they stand for."""
    return {"scene": DIGEST_VERSION, "schema": SCHEMA_VERSION, "elements": ELEMENTS_VERSION, "filter": FILTER_VERSION}


def check_versions(entry: dict[str, Any], store_url: str) -> None:
    """Checks that a published run was made by this code: else its units have other keys and would seem missing.

    Args:
        entry: the scene's entry in the store.
        store_url: of that store, for the message.

    Raises:
        VersionError: another version made it.
    """
    made, here = entry.get(ENTRY, _UNRECORDED), code_versions()
    if made == here:
        return
    differing = [name for name in here if made.get(name) != here[name]] or sorted(made.keys() - here.keys())
    made_text = ", ".join(f"{name} {made.get(name, 'unknown')}" for name in differing)
    here_text = ", ".join(f"{name} {here.get(name, 'unknown')}" for name in differing)
    raise VersionError(
        f"scene {entry['name']!r} in {store_url} must be made by this version, but it was made by another version "
        f"({made_text}; this is {here_text}); "
        f"run again: lightwell run {entry.get('source', 'SCENE')} --store {store_url}"
    )
