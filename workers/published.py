"""Which scenes of a store a run has published. Light to import: no Mitsuba, no torch."""

from typing import Any

from storage.store import Store

FIELDS = ("name", "digest", "network", "width", "height", "preset", "psnr")


def renderable_scenes(store: Store) -> list[dict[str, Any]]:
    """Scenes of a store that can be served, each with `FIELDS`; "network" is the key of its trained network."""
    return [{name: entry.get(name) for name in FIELDS} for entry in store.scenes() if "network" in entry]
