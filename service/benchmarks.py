"""Benchmarks of scenes: measured one at a time, kept as one JSON a scene, written as one page.

    <store>/benchmarks/<scene>.json     of the scenes measured in a store
    docs/benchmarks/<scene>.json        beside the page: of all scenes on it, whichever store they were measured in

A scene that is measured again replaces its record; an ablation that was not asked for again is kept, with the
command, commit and machine that gave it.
"""

import json
import os
import shlex
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.ablations import measure_ablation
from service.benchmark_page import render_page
from service.cost_curves import CURVES
from service.cost_curves_plot import cost_curves_plot
from service.errors import ServiceError
from service.options import write_file
from service.outcome import json_values
from service.tradeoff import TRADES
from service.tradeoff_plot import tradeoff_plot

if TYPE_CHECKING:
    from storage.durable import FileTree
    from storage.store import Store
    from workers.pipeline import Evaluation
    from workers.progress import Progress
    from workers.scene import Scene
    from workers.settings import Settings

FOLDER = "benchmarks"
SCHEMA = 1

Record = dict[str, Any]


class BenchmarkError(ServiceError, ValueError):
    """A benchmark record of the store cannot be read."""


@dataclass(frozen=True, kw_only=True)
class BenchmarkRequest:
    """What one `lightwell benchmark` asks of one scene.

    Attributes:
        source: the scene as it was given.
        store_url: the store as it was given.
        preset: name of a preset.
        resolution: of the run, "WIDTHxHEIGHT" or None for the scene's own.
        assignments: settings, "key=value".
        size: (width, height) of the timed frame, pixels.
        repeats: timed rounds.
        ablate: also run the ablation.
    """

    source: str
    store_url: str
    preset: str
    resolution: str | None
    assignments: tuple[str, ...] = ()
    size: tuple[int, int] = (1920, 1080)
    repeats: int = 7
    ablate: bool = False

    @property
    def command(self) -> str:
        """The command line that asks for the same, without absolute paths."""
        scene = ["--scene", shown_path(self.source)]
        size = ["--size", f"{self.size[0]}x{self.size[1]}", "--repeats", str(self.repeats)]
        rest = [*size, "--ablate"] if self.ablate else size
        return shown_command(
            ["benchmark", *scene], self.store_url, self.preset, self.resolution, self.assignments, rest
        )


def shown_command(
    words: list[str], store_url: str, preset: str, resolution: str | None, assignments: Iterable[str],
    rest: Iterable[str] = (),
) -> str:  # fmt: skip
    """A command line that may be published: `words` follow "lightwell", `rest` comes last."""
    line = ["lightwell", *words, "--store", shown_path(store_url), "--preset", preset]
    line += ["--resolution", resolution] if resolution else []
    line += [word for assignment in assignments for word in ("--set", assignment)]
    return shlex.join([*line, *rest])


def shown_path(text: str) -> str:
    """A path that may be published: as given where that is relative, else from the working folder, or only
    its last two parts where it lies elsewhere."""
    path = Path(text.removeprefix("file://"))
    if not path.is_absolute():
        return text
    relative = Path(os.path.relpath(path))
    return str(relative if relative.parts.count("..") <= 1 else Path(*path.parts[1:][-2:]))


def measure(
    scene: "Scene", store: "Store", settings: "Settings", request: BenchmarkRequest, progress: "Progress"
) -> "Evaluation":
    """Runs a scene (whatever the store lacks of it), times its parts and keeps the record.

    The record is kept before the ablation starts, and again when it has ended.

    Returns:
        The run's evaluation.
    """
    from workers.benchmark import measure_scene
    from workers.pipeline import run_scene

    evaluation = run_scene(scene, store, settings, progress, camera_size=(settings.width, settings.height))
    result = evaluation.result
    record: Record = {
        "schema": SCHEMA, "scene": scene.name, "source": shown_path(request.source),
        "digest": scene.digest, "command": request.command, "commit": result["commit"], "measured_at": _now(),
        "machine": result["machine"], "result": result,
        **measure_scene(scene, store, request.size, request.repeats, progress),
    }  # fmt: skip
    record = merge(_read(store.files, record_file(scene.name)), record)
    save(store.files, record)
    if request.ablate:
        ablation = measure_ablation(scene, store, settings, progress, request.command)
        save(store.files, record | {"ablation": ablation, "measured_at": _now()})
    return evaluation


def keep_ablation(store: "Store", digest: str, ablation: Record) -> bool:
    """Puts an ablation, of all rows or of a selection, beside the scene's record.

    Returns:
        False where the scene was not measured in this store.
    """
    record = _read(store.files, record_file(ablation["scene"]))
    if record is None or record["digest"] != digest:
        return False
    key = "selection" if ablation.get("selected") else "ablation"
    save(store.files, record | {key: ablation, "measured_at": _now()})
    return True


def merge(previous: Record | None, record: Record) -> Record:
    """A new record with what an older one of the same scene still tells.

    Kept are its ablations, and, where the settings are the same too, the seconds of stages that found their
    work in the store this time.
    """
    if previous is None or previous["digest"] != record["digest"]:
        return record
    kept = _ablations(previous)
    result, old = record["result"], previous["result"]
    if old["settings"] == json_values(result["settings"]):
        known = {stage["name"]: stage for stage in old["stages"]}
        stages = list((known | {stage["name"]: stage for stage in result["stages"]}).values())
        record = record | {"result": result | {"stages": stages}}
    return kept | record


def _ablations(record: Record) -> Record:
    """Those of all rows and of a selection."""
    return {key: record[key] for key in ("ablation", "selection") if key in record}


# ------------------------------------------------- at rest -------------------------------------------------


def _now() -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())


def record_file(scene: str) -> str:
    """Where a scene's record lies, relative to a store or to the folder of the page."""
    return f"{FOLDER}/{scene}.json"


def save(files: "FileTree", record: Record) -> None:
    """Writes a record, whole or not at all."""
    files.write(record_file(record["scene"]), json_bytes(record))


def json_bytes(value: Any) -> bytes:
    """The value as a JSON file; what is not finite becomes null."""
    return f"{json.dumps(json_values(value), indent=2, allow_nan=False)}\n".encode()


def load_all(files: "FileTree") -> list[Record]:
    """Every record, by scene name.

    Raises:
        BenchmarkError: one cannot be read.
    """
    names = [name for name in files.names(FOLDER) if name.endswith(".json")]
    records = [_read(files, f"{FOLDER}/{name}") for name in names if not name.startswith(".")]
    return sorted((record for record in records if record), key=lambda record: str(record["scene"]))


def _read(files: "FileTree", file: str) -> Record | None:
    data = files.read(file)
    if data is None:
        return None
    try:
        record = json.loads(data)
    except ValueError:
        record = None
    if not isinstance(record, dict) or record.get("schema") != SCHEMA:
        found = record.get("schema") if isinstance(record, dict) else "no JSON object"
        raise BenchmarkError(
            f"benchmark record must be JSON of schema {SCHEMA}, got {found} in {files.path(file)}; "
            "delete it and measure the scene again"
        )
    return record


def write_page(store: "Store", output: Path) -> int:
    """Writes the page of all records of a store and of those beside the page; returns how many scenes it shows.

    Of two records of a scene the one measured later counts. All of them lie beside the page afterwards, so that a
    scene can be measured again without the stores of the others.
    """
    from storage.durable import FileTree

    beside = FileTree(output.absolute().parent)
    known = {record["scene"]: record for record in load_all(beside)}
    for record in load_all(store.files):
        older = known.get(record["scene"], {})
        if record.get("measured_at", "") >= older.get("measured_at", ""):
            kept = _ablations(older) if older.get("digest") == record["digest"] else {}
            save(beside, kept | record)
    for kind, plot in ((CURVES, cost_curves_plot), (TRADES, tradeoff_plot)):
        for record in kind.copy(store.files, beside):
            beside.write(f"{kind.folder}/{record['scene']}.png", plot(record["result"], ".png"))
    records = load_all(beside)
    write_file(output, render_page(records, CURVES.load(beside), TRADES.load(beside)).encode())
    return len(records)
