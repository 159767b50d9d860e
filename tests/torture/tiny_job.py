"""The job that the engine's tests repeat: the tiny scene, without anything that depends on the clock."""

import hashlib
import json
from pathlib import Path
from typing import Any

from workers.job_spec import JobSpec
from workers.settings import Settings

ROOT = Path(__file__).parents[2]
TIMES = ("created_unix_s", "seconds")  # of a marker: when and how long, not what
MEASURED = ("evaluation",)  # stages whose files hold times


def tiny_spec(**overrides: Any) -> JobSpec:
    """Epochs instead of seconds, and fp32 instead of what measures fastest."""
    fixed = {"train.seconds": 0.0, "train.precision": "fp32", "evaluation.qualities": ("fast",)}
    settings = Settings.preset_named("tiny").override({**fixed, **overrides})
    return JobSpec(scene="tiny", settings=settings.to_json())


def run_in_process(spec: JobSpec, store_url: str) -> None:
    """The pipeline without an engine: what every other way must equal."""
    from storage.store import Store
    from workers.pipeline import run_scene
    from workers.progress import Progress
    from workers.scene import load_scene

    settings = Settings.from_json(spec.settings)
    scene = load_scene(spec.scene, width=settings.width, height=settings.height)
    run_scene(scene, Store.open(store_url, create=True), settings, Progress())


def committed(store: Path) -> dict[str, str]:
    """Path and hash of every committed file, and of every marker without its times."""
    found = {str(path.relative_to(store)): _plain(path) for path in store.glob("scenes/*/scene.json")}
    for marker in [*store.glob("scenes/*/*/*/commit.json"), *store.glob("scenes/*/*/*/units/*.json")]:
        folder = marker.parent if marker.name == "commit.json" else marker.parent.parent
        if folder.parent.name in MEASURED:
            continue
        found[str(marker.relative_to(store))] = _plain(marker)
        for name in json.loads(marker.read_text())["files"]:
            file = folder / name
            found[str(file.relative_to(store))] = hashlib.sha256(file.read_bytes()).hexdigest()
    return found


def _plain(marker: Path) -> str:
    fields = json.loads(marker.read_text())
    kept = {name: value for name, value in fields.items() if name not in (*TIMES, "marker_sha256")}
    return hashlib.sha256(json.dumps(kept, sort_keys=True).encode()).hexdigest()


def differences(one: dict[str, str], other: dict[str, str]) -> list[str]:
    """Paths that only one of them has, or that differ."""
    return sorted(path for path in one.keys() | other.keys() if one.get(path) != other.get(path))
