"""The list of scenes: fresh for a moment, read once for all, looked at again for a name that it lacks."""

import asyncio
import threading
import time
from typing import Any

import pytest

from service.catalogue import Catalogue
from service.errors import AmbiguousSceneError, UnknownSceneError


class Source:
    def __init__(self) -> None:
        self.entries: list[dict[str, Any]] = [{"name": "hall", "digest": "d1", "network": "n1"}]
        self.threads: list[int] = []

    def read(self) -> list[dict[str, Any]]:
        self.threads.append(threading.get_ident())
        time.sleep(0.02)
        return list(self.entries)


def test_a_fresh_list_is_used_again_and_read_off_the_event_loop() -> None:
    source = Source()

    async def scenario() -> None:
        catalogue = Catalogue(source.read, fresh_s=60)
        assert (await catalogue.resolve("hall"))["network"] == "n1"
        assert (await catalogue.resolve("d1"))["name"] == "hall"

    asyncio.run(scenario())
    assert len(source.threads) == 1 and threading.get_ident() not in source.threads


def test_many_at_once_read_once() -> None:
    source = Source()

    async def scenario() -> None:
        catalogue = Catalogue(source.read, fresh_s=60)
        await asyncio.gather(*(catalogue.scenes() for _ in range(20)))

    asyncio.run(scenario())
    assert len(source.threads) == 1


def test_a_stale_list_is_read_again() -> None:
    source = Source()

    async def scenario() -> None:
        catalogue = Catalogue(source.read, fresh_s=0)
        await catalogue.resolve("hall")
        source.entries = [{"name": "hall", "digest": "d1", "network": "n2"}]
        assert (await catalogue.resolve("hall"))["network"] == "n2"

    asyncio.run(scenario())


def test_a_name_published_a_moment_ago_is_found() -> None:
    source = Source()

    async def scenario() -> None:
        catalogue = Catalogue(source.read, fresh_s=60)
        await catalogue.scenes()
        source.entries.append({"name": "attic", "digest": "d2", "network": "n1"})
        assert (await catalogue.resolve("attic"))["digest"] == "d2"
        with pytest.raises(UnknownSceneError, match=r"\(attic, hall\), got 'cellar'"):
            await catalogue.resolve("cellar")

    asyncio.run(scenario())
    assert len(source.threads) == 3


def test_a_name_of_two_scenes_is_refused_with_their_digests() -> None:
    source = Source()
    source.entries.append({"name": "hall", "digest": "d2", "network": "n1"})
    with pytest.raises(AmbiguousSceneError, match="d1, d2"):
        asyncio.run(Catalogue(source.read).resolve("hall"))
