"""One computation for all who ask at once; none where nobody waits."""

import asyncio

import pytest

from service.single_flight import SingleFlight


class Work:
    """Counts how often it was started, finished and cancelled; ends when `gate` is set."""

    def __init__(self) -> None:
        self.gate = asyncio.Event()
        self.started = self.finished = self.cancelled = 0
        self.failure: Exception | None = None

    async def run(self) -> int:
        self.started += 1
        try:
            await self.gate.wait()
        except asyncio.CancelledError:
            self.cancelled += 1
            raise
        self.finished += 1
        if self.failure is not None:
            raise self.failure
        return self.started


async def _settle() -> None:
    for _ in range(5):
        await asyncio.sleep(0)


def test_equal_keys_share_one_computation_and_later_ones_start_anew() -> None:
    async def scenario() -> None:
        flights: SingleFlight[str, int] = SingleFlight()
        work = Work()
        callers = [asyncio.create_task(flights.run("a", work.run)) for _ in range(5)]
        await _settle()
        assert "a" in flights and len(flights) == 1
        work.gate.set()
        assert await asyncio.gather(*callers) == [1] * 5
        assert len(flights) == 0
        assert await flights.run("a", work.run) == 2

    asyncio.run(scenario())


def test_one_that_leaves_does_not_disturb_the_others() -> None:
    async def scenario() -> None:
        flights: SingleFlight[str, int] = SingleFlight()
        work = Work()
        first, second = (asyncio.create_task(flights.run("a", work.run)) for _ in range(2))
        await _settle()
        first.cancel()
        await _settle()
        work.gate.set()
        assert await second == 1
        assert first.cancelled() and work.cancelled == 0

    asyncio.run(scenario())


def test_the_last_one_that_leaves_ends_it_and_a_newcomer_starts_anew() -> None:
    async def scenario() -> None:
        flights: SingleFlight[str, int] = SingleFlight()
        work = Work()
        callers = [asyncio.create_task(flights.run("a", work.run)) for _ in range(2)]
        await _settle()
        for caller in callers:
            caller.cancel()
        await asyncio.wait(callers)
        assert len(flights) == 0
        newcomer = asyncio.create_task(flights.run("a", work.run))
        await _settle()
        assert (work.started, work.cancelled) == (2, 1)
        work.gate.set()
        assert await newcomer == 2

    asyncio.run(scenario())


def test_an_error_reaches_every_caller() -> None:
    async def scenario() -> None:
        flights: SingleFlight[str, int] = SingleFlight()
        work = Work()
        work.failure = ValueError("broken")
        work.gate.set()
        outcomes = await asyncio.gather(*(flights.run("a", work.run) for _ in range(3)), return_exceptions=True)
        assert [str(outcome) for outcome in outcomes] == ["broken"] * 3
        with pytest.raises(ValueError, match="broken"):
            await flights.run("a", work.run)
        assert work.started == 2

    asyncio.run(scenario())
