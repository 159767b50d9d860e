"""`lightwell cost-curves`: how bake, bytes and query follow a scene's number of triangles."""

from pathlib import Path
from typing import Annotated

import typer

from service.errors import OptionError
from service.failures import reported
from service.options import check_writable, parse_overrides, parse_size, write_file
from service.outcome import Outputs

MIB = 2**20


def parse_counts(text: str) -> tuple[int, ...]:
    """ "10000,100000" as numbers.

    Raises:
        OptionError: something else.
    """
    try:
        return tuple(int(word) for word in text.replace("_", "").split(","))
    except ValueError as error:
        raise OptionError(f"--triangles must be whole numbers with commas between them, got {text!r}") from error


def cost_curves(
    scene: Annotated[str, typer.Argument(help="a Mitsuba .xml, a .yaml, a mesh, or tabletop or tiny")],
    triangles: Annotated[str, typer.Option("--triangles", help="numbers of triangles")] = "10000,100000,1000000",
    store: Annotated[
        str | None, typer.Option("--store", help="keep the record there, for the page that `benchmark` writes")
    ] = None,
    preset: Annotated[str, typer.Option("--preset", help="draft, balanced or reference")] = "draft",
    resolution: Annotated[
        str | None, typer.Option("--resolution", help="WIDTHxHEIGHT of the run's cameras; default: the scene's own")
    ] = None,
    assignments: Annotated[
        list[str] | None, typer.Option("--set", help="key=value, a setting of all caches; may be given again")
    ] = None,
    size: Annotated[str, typer.Option("--size", help="WIDTHxHEIGHT of the queried frame")] = "640x360",
    repeats: Annotated[int, typer.Option("--repeats", min=1, help="timed rounds; medians count")] = 7,
    sample_paths: Annotated[
        int, typer.Option("--sample-paths", min=1, help="of each lobe, baked at least; the rest is extrapolated")
    ] = 6_000_000,
    memory_mib: Annotated[
        int, typer.Option("--memory-mib", min=1, help="larger caches are not opened: their query is not timed")
    ] = 4096,
    json_file: Annotated[Path | None, typer.Option("--json", help="also write the result as JSON")] = None,
    plot_file: Annotated[Path | None, typer.Option("--plot", help="also draw it: a .png, .svg or .pdf file")] = None,
) -> None:
    """Measure elements, bake, bytes, memory and query time at several numbers of triangles, and fit exponents.

    More triangles by tessellation, fewer by clustering vertices. Needs no store: what is baked is thrown away.
    """
    with reported():
        outputs = Outputs(json=json_file)
        counts = parse_counts(triangles)
        from service.tradeoff_plot import plot_suffix

        if plot_file is not None:
            plot_suffix(plot_file)
            check_writable(plot_file, "--plot")
        from service.benchmarks import json_bytes, shown_path
        from service.cost_curves import CURVES, cost_curves_table
        from service.cost_curves_plot import cost_curves_plot
        from service.progress import RichProgress
        from service.table import show
        from storage.store import Store
        from workers.cost_curves import CurveBudget, run_cost_curves
        from workers.scene import load_scene
        from workers.settings import Settings

        overrides = parse_overrides(assignments or [])
        budget = CurveBudget(
            triangles=counts, frame_size=parse_size(size), repeats=repeats, sample_paths=sample_paths,
            memory_nbytes=memory_mib * MIB, overrides=tuple(overrides.items()),
        )  # fmt: skip
        opened = Store.open(store, create=True) if store is not None else None
        width, height = parse_size(resolution, "--resolution") if resolution else (None, None)
        loaded = load_scene(scene, width=width, height=height)
        own_size = {"width": loaded.camera.width, "height": loaded.camera.height}
        settings = Settings.preset_named(preset).override({**own_size, **loaded.settings, **overrides})
        with RichProgress() as progress:
            result = run_cost_curves(loaded, settings, budget, progress)
        show(cost_curves_table(result))
        if opened is not None:
            command = ["cost-curves", shown_path(scene), "--triangles", triangles, "--preset", preset]
            CURVES.keep(opened.files, result, _shown(command, store or "", resolution, assignments, size, repeats))
        if outputs.json is not None:
            write_file(outputs.json, json_bytes(result))
        if plot_file is not None:
            write_file(plot_file, cost_curves_plot(result, plot_suffix(plot_file)))


def _shown(
    words: list[str], store: str, resolution: str | None, assignments: list[str] | None, size: str, repeats: int
) -> str:
    """The command line that asks for the same, without absolute paths."""
    import shlex

    from service.benchmarks import shown_path

    line = ["lightwell", *words, "--store", shown_path(store), "--size", size, "--repeats", str(repeats)]
    line += ["--resolution", resolution] if resolution else []
    return shlex.join([*line, *(word for assignment in assignments or [] for word in ("--set", assignment))])
