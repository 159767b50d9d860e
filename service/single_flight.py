"""The same thing, asked for several times at once, is made once."""

import asyncio
from collections.abc import Callable, Coroutine, Hashable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


@dataclass
class _Flight(Generic[V]):
    task: "asyncio.Task[V]"
    num_waiting: int = 0


class SingleFlight(Generic[K, V]):
    """Callers with equal keys share one computation and its outcome, also its error.

    A caller that is cancelled leaves; when the last one left, the computation is cancelled too. Nothing is kept
    after it has ended. Belongs to one event loop.
    """

    def __init__(self) -> None:
        self._flights: dict[K, _Flight[V]] = {}

    def __len__(self) -> int:
        """Computations under way."""
        return len(self._flights)

    def __contains__(self, key: K) -> bool:
        return key in self._flights

    async def run(self, key: K, make: Callable[[], Coroutine[Any, Any, V]]) -> V:
        """The value of `key`: of the computation under way, else of `make()`, started now."""
        flight = self._flights.get(key)
        if flight is None:
            flight = self._flights[key] = _Flight(asyncio.get_running_loop().create_task(make()))
            flight.task.add_done_callback(lambda _: self._forget(key, flight))
        flight.num_waiting += 1
        try:
            return await asyncio.shield(flight.task)
        finally:
            flight.num_waiting -= 1
            if not flight.num_waiting and not flight.task.done():
                self._forget(key, flight)  # before it has ended: who comes now starts anew
                flight.task.cancel()

    def _forget(self, key: K, flight: "_Flight[V]") -> None:
        if self._flights.get(key) is flight:
            del self._flights[key]
