"""Runs that a worker process keeps loaded: scenes, element sets and query programs, the last few used.

Loading a scene and compiling its query cost seconds; a unit of work is often no longer than that.
"""

from functools import cached_property

from cachetools import LRUCache

from storage.store import Store
from workers.element_stage import run_elements
from workers.elements import ElementSet
from workers.job_spec import JobSpec
from workers.pipeline import query_program
from workers.plan_stage import planned_run
from workers.progress import Progress
from workers.query import QueryProgram
from workers.run_state import RunState
from workers.scene import Scene, load_scene
from workers.settings import Settings

MAX_SCENES = 2
MAX_RUNS = 3


class LoadedRun:
    """A run and what its units share."""

    def __init__(self, run: RunState) -> None:
        self.run = run

    @cached_property
    def elements(self) -> ElementSet:
        return run_elements(self.run)

    @cached_property
    def program(self) -> QueryProgram:
        """The query over all caches of the run."""
        return query_program(self.run, self.elements)


_scenes: LRUCache[tuple[str, int, int], Scene] = LRUCache(MAX_SCENES)
_runs: LRUCache[tuple[str, str], LoadedRun] = LRUCache(MAX_RUNS)


def open_run(spec: JobSpec, store_url: str, progress: Progress) -> LoadedRun:
    """The run of a spec, loaded now or before; its progress goes to `progress` from now on.

    Raises:
        SceneError, SettingsError, StorageError: scene, settings or store cannot be used.
    """
    key = (store_url, spec.canonical)
    loaded = _runs.get(key)
    if loaded is None:
        settings = Settings.from_json(spec.settings).override({})
        run = RunState(_scene(spec.scene, settings), Store.open(store_url, create=True), settings, progress)
        run = planned_run(run)
        loaded = _runs[key] = LoadedRun(run)
    loaded.run.progress = progress
    return loaded


def _scene(source: str, settings: Settings) -> Scene:
    key = (source, settings.width, settings.height)
    scene = _scenes.get(key)
    if scene is None:
        scene = _scenes[key] = load_scene(source, width=settings.width, height=settings.height)
    return scene


def forget_runs() -> None:
    """Drops everything that is loaded: a scene's files may have changed."""
    _runs.clear()
    _scenes.clear()
