"""`lightwell batch plan|run` and `lightwell dataset`: many scenes, presets and variations, and one dataset of them."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.errors import OptionError
from service.failures import reported
from service.options import parse_overrides, parse_size, write_file

if TYPE_CHECKING:
    from storage.store import Store
    from workers.batch_matrix import BatchItem

EXIT_INCOMPLETE = 1
batch_app = typer.Typer(name="batch", help="Many scenes, presets and variations from one YAML file.",
                        no_args_is_help=True)  # fmt: skip

MatrixArgument = Annotated[Path, typer.Argument(help="a YAML file: scenes x presets x variations")]
StoreOption = Annotated[str, typer.Option("--store", help="folder or URL that holds everything that is computed")]
JsonOption = Annotated[Path | None, typer.Option("--json", help="also write the result as JSON")]


@batch_app.command("plan")
def plan(matrix: MatrixArgument, store: StoreOption, json_file: JsonOption = None) -> None:
    """Show every combination: its variant, its frames, and those that are still missing. Renders nothing."""
    with reported():
        from service.progress import RichProgress
        from storage.store import Store
        from workers.batch import plan_batch
        from workers.batch_matrix import read_matrix

        items = read_matrix(matrix)
        with RichProgress() as progress:
            rows = plan_batch(items, Store.open(store, create=True), progress)
        for row in rows:
            print(f"{row['label']}: {row['scene']} ({row['digest'][:12]}), {row['width']}x{row['height']}, "
                  f"{row['num_missing']} of {row['num_frames']} frames to render, "
                  f"{row['paths'] / 1e6:.1f} M paths, {len(row['variation'].get('changes', ()))} changes")  # fmt: skip
        total = sum(row["paths"] for row in rows)
        print(f"{len(rows)} combinations, {sum(row['num_missing'] for row in rows)} frames to render, "
              f"{total / 1e6:.1f} M paths")  # fmt: skip
        _write_json(json_file, {"combinations": rows})


@batch_app.command("run")
def run(matrix: MatrixArgument, store: StoreOption, json_file: JsonOption = None) -> None:
    """Run every combination. Started again, it goes on where it stopped; exit code 1 where one failed."""
    with reported():
        from workers.batch_matrix import read_matrix

        items = read_matrix(matrix)
        results = _run(items, _open(store))
        _write_json(json_file, {"combinations": results})
        _summarise(results)


def dataset(
    store: StoreOption,
    output: Annotated[str, typer.Option("--output", "-o", help="the dataset's folder or URL")],
    matrix: Annotated[Path | None, typer.Argument(help="a YAML file: scenes x presets x variations")] = None,
    scene: Annotated[
        str | None, typer.Option("--scene", help="in place of a file: one scene's file, or its name in the store")
    ] = None,
    preset: Annotated[str, typer.Option("--preset", help="with --scene: draft, balanced or reference")] = "draft",
    resolution: Annotated[str | None, typer.Option("--resolution", help="with --scene: WIDTHxHEIGHT")] = None,
    assignments: Annotated[list[str] | None, typer.Option("--set", help="with --scene: key=value")] = None,
    inputs: Annotated[str, typer.Option("--inputs", help="with --scene: samples of the noisy frames, or none")] = "1",
    split_by: Annotated[str, typer.Option("--split", help="path or scene")] = "path",
    json_file: JsonOption = None,
) -> None:
    """Render what is missing and write one dataset: noisy frames, references, manifest, train/valid/test."""
    with reported():
        if (matrix is None) == (scene is None):
            raise OptionError("dataset must be given a YAML file or --scene, one of the two")
        if split_by not in ("path", "scene"):
            raise OptionError(f"--split must be path or scene, got {split_by!r}")
        opened = _open(store)
        if matrix is not None:
            from workers.batch_matrix import read_matrix

            items = read_matrix(matrix)
        else:
            assert scene is not None
            items = [_one_item(scene, opened, preset, resolution, assignments or [], inputs)]
        results = _run(items, opened)
        failed = {result["label"] for result in results if result["error"] is not None}
        manifest = _write(items, failed, opened, output, split_by)
        counts = ", ".join(f"{count} {split}" for split, count in manifest["splits"].items())
        print(f"{output}: {len(manifest['frames'])} frames of {len(manifest['scenes'])} variants ({counts}), "
              f"{len(manifest['excluded'])} images left out")  # fmt: skip
        _write_json(json_file, {"combinations": results, "splits": manifest["splits"],
                                "excluded": manifest["excluded"]})  # fmt: skip
        _summarise(results)


def _write(items: "list[BatchItem]", failed: set[str], store: "Store", output: str, split_by: str) -> dict[str, Any]:
    from service.progress import RichProgress
    from workers.batch import open_items
    from workers.dataset import write_dataset

    usable = [item for item in items if item.label not in failed]
    bases = [item.base for item in items]
    with RichProgress() as progress:
        runs = open_items(usable, store, progress)
        return write_dataset(runs, output, split_by=split_by, bases=bases)  # type: ignore[arg-type]  # checked above


def _one_item(scene: str, store: "Store", preset: str, resolution: str | None, assignments: list[str],
              inputs: str) -> "BatchItem":  # fmt: skip
    """One scene as a batch of one: a file or built-in scene with options, or what a run left in the store."""
    from workers.batch_matrix import BatchItem
    from workers.settings import Settings

    spp = _parse_inputs(inputs)
    known = {entry["name"]: entry for entry in store.scenes()} | {entry["digest"]: entry for entry in store.scenes()}
    entry = known.get(scene)
    if entry is not None and "settings" in entry:
        settings = Settings.from_json(entry["settings"])
        return BatchItem(label=scene, base=entry["name"], scene=entry["source"], preset=settings.preset,
                         preset_name=settings.preset, resolution=(settings.width, settings.height), input_spp=spp,
                         settings=settings)  # fmt: skip
    return BatchItem(label=scene, base=scene, scene=scene, preset=preset, preset_name=preset, input_spp=spp,
                     overrides=dict(parse_overrides(assignments)),
                     resolution=parse_size(resolution, "--resolution") if resolution else None)  # fmt: skip


def _parse_inputs(text: str) -> tuple[int, ...]:
    """ "1,4" as (1, 4); "none" as ().

    Raises:
        OptionError: something else.
    """
    if text.strip() == "none":
        return ()
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() and 0 < int(part) < 1_000_000 for part in parts):
        raise OptionError(f"--inputs must be samples a pixel such as 1,4, or none, got {text!r}")
    return tuple(sorted({int(part) for part in parts}))


def _open(store: str) -> "Store":
    from storage.store import Store

    return Store.open(store, create=True)


def _run(items: "list[BatchItem]", store: "Store") -> list[dict[str, Any]]:
    from service.progress import RichProgress
    from workers.batch import run_batch

    with RichProgress() as progress:
        return [result.to_json() for result in run_batch(items, store, progress)]


def _summarise(results: list[dict[str, Any]]) -> None:
    failed = [result for result in results if result["error"] is not None]
    rendered, frames = (sum(result[key] for result in results) for key in ("num_rendered", "num_frames"))
    print(
        f"{len(results) - len(failed)} of {len(results)} combinations complete, {rendered} of {frames} frames rendered"
    )
    for result in failed:
        print(f"  failed: {result['label']}: {result['error']}")
    if failed:
        raise typer.Exit(EXIT_INCOMPLETE)


def _write_json(path: Path | None, content: dict[str, Any]) -> None:
    if path is not None:
        write_file(path, (json.dumps(content, indent=1) + "\n").encode())
