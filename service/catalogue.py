"""Which scenes can be served now: the store's list, read again after a moment, and a scene by name or digest."""

import asyncio
import time
from collections.abc import Callable
from typing import Any

from service.errors import AmbiguousSceneError, UnknownSceneError
from service.single_flight import SingleFlight

FRESH_S = 1.0
"""So long a list is good: a network that replaces another is served at most this much later."""

Entry = dict[str, Any]


def resolve_scene(scenes: list[Entry], name_or_digest: str) -> Entry:
    """The entry of the one scene that has this name or digest.

    Raises:
        UnknownSceneError: none has it.
        AmbiguousSceneError: several scenes share the name.
    """
    found = {scene["digest"]: scene for scene in scenes if name_or_digest in (scene["name"], scene["digest"])}
    if not found:
        names = ", ".join(sorted({scene["name"] for scene in scenes})) or "none yet"
        raise UnknownSceneError(
            f"scene must be one that this store can serve ({names}), got {name_or_digest!r}; "
            "'lightwell run SCENE --store DIR' adds one"
        )
    if len(found) > 1:
        raise AmbiguousSceneError(
            f"scene must name one scene, got {name_or_digest!r} which {len(found)} share; "
            f"give a digest: {', '.join(sorted(found))}"
        )
    return found.popitem()[1]


class Catalogue:
    """The list of scenes, read off the event loop and at most once at a time.

    Args:
        read: lists the scenes; called on a thread of its own.
        fresh_s: age up to which a list is used again, seconds.
    """

    def __init__(self, read: Callable[[], list[Entry]], *, fresh_s: float = FRESH_S) -> None:
        self._read, self._fresh_s = read, fresh_s
        self._scenes: list[Entry] = []
        self._read_at_s = -float("inf")
        self._reading: SingleFlight[None, None] = SingleFlight()

    async def scenes(self) -> list[Entry]:
        """The scenes that can be served, at most `fresh_s` old."""
        if time.monotonic() - self._read_at_s > self._fresh_s:
            await self._refresh()
        return self._scenes

    async def resolve(self, name_or_digest: str) -> Entry:
        """The entry of a scene; a name that the list lacks is looked for in the store before it is refused.

        Raises:
            UnknownSceneError, AmbiguousSceneError: as `resolve_scene`.
        """
        asked_s = time.monotonic()
        scenes = await self.scenes()
        try:
            return resolve_scene(scenes, name_or_digest)
        except UnknownSceneError:
            if self._read_at_s >= asked_s:
                raise
        await self._refresh()
        return resolve_scene(self._scenes, name_or_digest)

    async def _refresh(self) -> None:
        await self._reading.run(None, self._read_now)

    async def _read_now(self) -> None:
        started_s = time.monotonic()
        self._scenes = await asyncio.to_thread(self._read)
        self._read_at_s = started_s
