"""Plans, one after the other, each in a process of its own: a plan loads a scene, bakes and trains for seconds."""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from service.apart import run_apart
from service.errors import BusyError

if TYPE_CHECKING:
    from workers.settings import Settings

MAX_WAITING = 4


def plan_source(source: str, settings: "Settings") -> dict[str, Any]:
    """What a run of this scene with these settings would do and cost."""
    from workers.pipeline import plan_scene
    from workers.scene import load_scene

    return plan_scene(load_scene(source, width=settings.width, height=settings.height), settings)


def plan_apart(source: str, settings: "Settings") -> dict[str, Any]:
    """`plan_source` in a process of its own."""
    return run_apart(plan_source, source, settings)


class Planner:
    """Makes plans.

    Args:
        make_plan: what makes one; called on the planner's thread.
    """

    def __init__(self, make_plan: "Callable[[str, Settings], dict[str, Any]]" = plan_apart) -> None:
        self._make_plan = make_plan
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="lightwell-plan")
        self._waiting = 0

    @property
    def num_waiting(self) -> int:
        """Plans that wait or are being made."""
        return self._waiting

    async def plan(self, source: str, settings: "Settings") -> dict[str, Any]:
        """A plan.

        Raises:
            BusyError: too many wait already.
            SceneError: the scene cannot be built.
        """
        if self._waiting >= MAX_WAITING:
            raise BusyError(f"plans that wait must be at most {MAX_WAITING}; ask again later")
        self._waiting += 1
        try:
            loop = asyncio.get_running_loop()
            return await loop.run_in_executor(self._thread, self._make_plan, source, settings)
        finally:
            self._waiting -= 1

    def close(self) -> None:
        """Drops the plans that wait."""
        self._thread.shutdown(wait=False, cancel_futures=True)
