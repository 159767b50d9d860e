"""The `lightwell` command. Mitsuba and torch are imported inside the commands: --help answers at once."""

import dataclasses
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.batch_cli import batch_app, dataset
from service.cost_curves_cli import cost_curves
from service.export_cli import export
from service.failures import reported
from service.jobs_cli import jobs_app
from service.options import check_writable, parse_look_at, parse_overrides, parse_size
from service.outcome import Outputs, finish, frame_request_lines
from service.verify_cli import verify

if TYPE_CHECKING:
    from workers.scene import Scene
    from workers.settings import Settings

app = typer.Typer(
    name="lightwell",
    help="Globally lit frames of a 3D scene from any camera pose: bake caches, train a network, measure.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.add_typer(jobs_app, name="jobs")
app.add_typer(batch_app)

SceneArgument = Annotated[
    str,
    typer.Argument(help="a Mitsuba .xml, a .yaml, a mesh (.glb .gltf .obj .ply .stl), or tabletop or tiny"),
]
StoreOption = Annotated[
    str, typer.Option("--store", help="folder, or s3://bucket/prefix, that holds everything that is computed")
]
PresetOption = Annotated[str, typer.Option("--preset", help="draft, balanced or reference: from fast to accurate")]
ResolutionOption = Annotated[
    str | None, typer.Option("--resolution", help="WIDTHxHEIGHT in pixels; default: the scene's own")
]
SetOption = Annotated[list[str] | None, typer.Option("--set", help="key=value, one setting; may be given again")]
JsonOption = Annotated[Path | None, typer.Option("--json", help="also write the result as JSON")]
ReportOption = Annotated[Path | None, typer.Option("--report", help="where the HTML report goes; default: the store")]
PictureOption = Annotated[Path | None, typer.Option("--picture", help="also write the first pictures as one PNG")]
BENCHMARKS_PAGE = Path("docs/benchmarks.md")


def _load(scene: str, resolution: str | None) -> "Scene":
    width, height = parse_size(resolution, "--resolution") if resolution else (None, None)
    from service.progress import RichProgress

    with RichProgress() as progress, progress.busy(f"load {scene}"):
        from workers.scene import load_scene

        return load_scene(scene, width=width, height=height)


def _settings(preset: str, scene: "Scene", assignments: list[str] | None) -> "Settings":
    """Preset, then what the scene's file asks for, then what the command line says."""
    from workers.settings import Settings

    size = {"width": scene.camera.width, "height": scene.camera.height}
    overrides = parse_overrides(assignments or [])
    return Settings.preset_named(preset).choose({**size, **scene.settings, **overrides})


def _run(scene: "Scene", store_url: str, settings: "Settings", outputs: Outputs) -> None:
    from service.progress import RichProgress
    from storage.store import Store
    from workers.pipeline import run_scene

    store = Store.open(store_url, create=True)
    size = (settings.width, settings.height)
    with RichProgress() as progress:
        for note in scene.notes:
            progress.message(f"note: {note}")
        evaluation = run_scene(scene, store, settings, progress, camera_size=size)
    finish(evaluation, store_url, outputs)


@app.command()
def demo(
    store: StoreOption = "./lightwell-demo",
    preset: Annotated[str, typer.Option("--preset", help="demo, draft, balanced or reference")] = "demo",
    resolution: ResolutionOption = "256x256",
    assignments: SetOption = None,
    json_file: JsonOption = None,
    report: ReportOption = None,
    picture: PictureOption = None,
) -> None:
    """Bake, train and measure the built-in tabletop, then say how to ask it for a frame."""
    with reported():
        outputs = Outputs(json=json_file, report=report, picture=picture)
        scene = _load("tabletop", resolution)
        _run(scene, store, _settings(preset, scene, assignments), outputs)
        with_server, without_server = frame_request_lines(scene.name, store, scene.camera)
        print(f"a frame, by HTTP:      {with_server}")
        print(f"a frame, as a command: {without_server}")


@app.command()
def plan(
    scene: SceneArgument,
    preset: PresetOption = "balanced",
    resolution: ResolutionOption = None,
    assignments: SetOption = None,
    json_file: JsonOption = None,
) -> None:
    """Show what a scene requires, why, and what a run costs, from an audit and a pilot bake of seconds.

    `lightwell run SCENE --planned` takes the choices; what --set gives is left as it is.
    """
    with reported():
        outputs = Outputs(json=json_file)
        loaded = _load(scene, resolution)
        settings = _settings(preset, loaded, assignments)
        from service.benchmarks import json_bytes
        from service.options import write_file
        from service.progress import RichProgress
        from service.table import plan_table, show
        from workers.pipeline import plan_scene

        with RichProgress() as progress, progress.busy("audit, pilot bake and calibration"):
            made = plan_scene(loaded, settings)
        show(plan_table(made))
        if outputs.json is not None:
            write_file(outputs.json, json_bytes(made))


@app.command()
def run(
    scene: SceneArgument,
    store: StoreOption,
    preset: PresetOption = "balanced",
    resolution: ResolutionOption = None,
    assignments: SetOption = None,
    json_file: JsonOption = None,
    report: ReportOption = None,
    picture: PictureOption = None,
    planned: Annotated[
        bool, typer.Option("--planned", help="let a plan of the scene replace the preset's numbers; see plan")
    ] = False,
) -> None:
    """Bake, render, train and evaluate. Started again, it goes on where it stopped."""
    with reported():
        outputs = Outputs(json=json_file, report=report, picture=picture)
        loaded = _load(scene, resolution)
        settings = _settings(preset, loaded, assignments)
        if planned:
            settings = settings.override({"plan.mode": "adaptive"})
        _run(loaded, store, settings, outputs)


@app.command()
def evaluate(
    scene: SceneArgument,
    store: StoreOption,
    preset: Annotated[
        str | None,
        typer.Option("--preset", help="of the run to measure; default: the one that the scene is served from"),
    ] = None,
    resolution: ResolutionOption = None,
    assignments: SetOption = None,
    json_file: JsonOption = None,
    report: ReportOption = None,
    picture: PictureOption = None,
) -> None:
    """Measure again what an earlier run made: with its own settings where no preset is given.

    `--set evaluation.spp=64` and the like change what it is compared to.
    """
    with reported():
        outputs = Outputs(json=json_file, report=report, picture=picture)
        from service.progress import RichProgress
        from storage.store import Store
        from workers.pipeline import evaluate_scene, published_settings

        opened = Store.open(store)
        loaded = _load(scene, resolution)
        if preset is None:
            settings = published_settings(loaded, opened).override(parse_overrides(assignments or []))
            if resolution is None:
                loaded = _load(scene, f"{settings.width}x{settings.height}")
            settings = settings.override({"width": loaded.camera.width, "height": loaded.camera.height})
        else:
            settings = _settings(preset, loaded, assignments)
        with RichProgress() as progress:
            evaluation = evaluate_scene(loaded, opened, settings, progress)
        finish(evaluation, store, outputs)


@app.command()
def ablate(
    scene: SceneArgument,
    store: StoreOption,
    preset: PresetOption = "draft",
    resolution: ResolutionOption = None,
    assignments: SetOption = None,
    rows: Annotated[
        list[str] | None, typer.Option("--row", help="only this row, by its name; may be given again")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Train and measure the paper's choices and ours, one change at a time. Hours on a real scene."""
    with reported():
        outputs = Outputs(json=json_file)
        from service.ablations import ablation_table, measure_ablation
        from service.benchmarks import json_bytes, keep_ablation, shown_command, shown_path
        from service.options import write_file
        from service.progress import RichProgress
        from service.table import show
        from storage.store import Store

        loaded = _load(scene, resolution)
        settings = _settings(preset, loaded, assignments)
        rest = [word for row in rows or () for word in ("--row", row)]
        command = shown_command(["ablate", shown_path(scene)], store, preset, resolution, assignments or [], rest)
        opened = Store.open(store, create=True)
        with RichProgress() as progress:
            ablation = measure_ablation(loaded, opened, settings, progress, command, rows or ())
        keep_ablation(opened, loaded.digest, ablation)
        show(ablation_table(ablation))
        if outputs.json is not None:
            write_file(outputs.json, json_bytes(ablation))


@app.command()
def tradeoff(
    scene: SceneArgument,
    store: StoreOption,
    preset: PresetOption = "draft",
    resolution: ResolutionOption = None,
    assignments: SetOption = None,
    json_file: JsonOption = None,
    plot_file: Annotated[Path | None, typer.Option("--plot", help="also draw it: a .png, .svg or .pdf file")] = None,
    network_seconds: Annotated[
        float, typer.Option("--network-seconds", help="training of each network, at most, seconds")
    ] = 60.0,
    sizes: Annotated[
        list[str] | None, typer.Option("--size", help="WIDTHxHEIGHT that is timed too; may be given again")
    ] = None,
    repeats: Annotated[int, typer.Option("--repeats", min=1, help="timed rounds; medians count")] = 5,
    paper: Annotated[bool, typer.Option("--paper/--no-paper", help="with the paper-exact configuration")] = True,
) -> None:
    """Measure error against time, bake and bytes over caches, query, network, precision and output scale.

    Keeps the operating points that `lightwell frame` and the service choose from. Trains about ten networks.
    """
    with reported():
        outputs = Outputs(json=json_file)
        from service.benchmarks import shown_command, shown_path
        from service.tradeoff import TRADES, tradeoff_table, write_tradeoff
        from service.tradeoff_plot import plot_suffix

        if plot_file is not None:
            plot_suffix(plot_file)
            check_writable(plot_file, "--plot")
        from service.progress import RichProgress
        from service.table import show
        from storage.store import Store
        from workers.tradeoff import run_tradeoff
        from workers.tradeoff_variants import TradeoffBudget

        budget = TradeoffBudget(network_seconds=network_seconds, repeats=repeats, paper=paper)
        if sizes:
            budget = dataclasses.replace(budget, sizes=tuple(map(parse_size, sizes)))
        loaded = _load(scene, resolution)
        settings = _settings(preset, loaded, assignments)
        opened = Store.open(store, create=True)
        with RichProgress() as progress:
            table = run_tradeoff(loaded, opened, settings, progress, budget)
        rest = [
            "--network-seconds",
            f"{network_seconds:g}",
            "--repeats",
            str(repeats),
            *([] if paper else ["--no-paper"]),
        ]
        rest += [word for size in sizes or [] for word in ("--size", size)]
        command = shown_command(["tradeoff", shown_path(scene)], store, preset, resolution, assignments or [], rest)
        TRADES.keep(opened.files, table.result, command)
        show(tradeoff_table(table.result))
        write_tradeoff(table.to_json(), outputs.json, plot_file)


@app.command()
def benchmark(
    store: StoreOption,
    output: Annotated[Path, typer.Option("--output", "-o", help="the Markdown page")] = BENCHMARKS_PAGE,
    scenes: Annotated[
        list[str] | None,
        typer.Option("--scene", help="measure this scene; may be given again; none: only write the page"),
    ] = None,
    preset: PresetOption = "draft",
    resolution: ResolutionOption = "256x256",
    assignments: SetOption = None,
    size: Annotated[str, typer.Option("--size", help="WIDTHxHEIGHT of the frame that is timed")] = "1920x1080",
    repeats: Annotated[int, typer.Option("--repeats", min=1, help="timed rounds; medians count")] = 7,
    with_ablation: Annotated[bool, typer.Option("--ablate", help="also run the ablation (hours)")] = False,
) -> None:
    """Measure scenes, keep the results in the store, and write the page of all scenes measured so far."""
    with reported():
        check_writable(output, "--output")
        from service.benchmarks import BenchmarkRequest, measure, write_page
        from service.progress import RichProgress
        from storage.store import Store

        opened = Store.open(store, create=bool(scenes))
        frame_size = parse_size(size)
        for source in scenes or []:
            request = BenchmarkRequest(
                source=source, store_url=store, preset=preset, resolution=resolution,
                assignments=tuple(assignments or ()), size=frame_size, repeats=repeats, ablate=with_ablation,
            )  # fmt: skip
            loaded = _load(source, resolution)
            settings = _settings(preset, loaded, assignments)
            with RichProgress() as progress:
                evaluation = measure(loaded, opened, settings, request, progress)
            finish(evaluation, store, Outputs())
            write_page(opened, output)
        print(f"{output}: measured scenes: {write_page(opened, output)}")


@app.command()
def frame(
    scene: SceneArgument,
    store: StoreOption,
    look_at: Annotated[str, typer.Option("--look-at", help="ox,oy,oz,tx,ty,tz,ux,uy,uz: origin, target, up")],
    output: Annotated[Path, typer.Option("--output", "-o", help="a .png, .jpg or .exr file")],
    fov: Annotated[float, typer.Option("--fov", help="field of view across the width, degrees")] = 45.0,
    size: Annotated[str, typer.Option("--size", help="WIDTHxHEIGHT in pixels")] = "640x360",
    quality: Annotated[
        str | None, typer.Option("--quality", help="draft, balanced or best of the points that tradeoff measured")
    ] = None,
    max_ms: Annotated[float | None, typer.Option("--max-ms", help="of the measured points, within so long")] = None,
    min_psnr: Annotated[float | None, typer.Option("--min-psnr", help="of the measured points, at least, dB")] = None,
) -> None:
    """One frame of a scene that a run has prepared, named by its file or by its name in the store."""
    with reported():
        from service.images import encode, media_type_of
        from service.options import write_file

        media_type = media_type_of(output)
        check_writable(output, "--output")
        width, height = parse_size(size)
        from workers.camera import Camera

        camera = Camera.look_at(*parse_look_at(look_at), fov, width, height)
        from storage.store import Store

        opened = Store.open(store)
        from service.frame_choice import Demand, render_chosen
        from service.progress import RichProgress

        name = _load(scene, None).digest if Path(scene).is_file() else scene
        demand = Demand(quality=quality, max_ms=max_ms, min_psnr=min_psnr)
        with RichProgress() as progress, progress.busy("open the scene and render"):
            rendered, choice = render_chosen(opened, name, camera, demand)
        write_file(output, encode(rendered.radiance, rendered.exposure, media_type))
        times = ", ".join(f"{step} {1e3 * seconds:.1f} ms" for step, seconds in rendered.seconds.items())
        print(f"{output}: {width}x{height}, {times}, coverage {100 * rendered.coverage:.1f} %, "
              f"non-finite values {rendered.non_finite}")  # fmt: skip
        if choice is not None:
            print(f"operating point {choice.point.name!r}: {choice.point.psnr:.2f} dB measured, "
                  f"{choice.ms:.1f} ms predicted")  # fmt: skip


@app.command()
def serve(
    store: StoreOption,
    host: Annotated[str | None, typer.Option("--host", help="address to listen on; default: 127.0.0.1")] = None,
    port: Annotated[int | None, typer.Option("--port", min=0, max=65535, help="default: 8000; 0: a free one")] = None,
    allow_unauthenticated: Annotated[
        bool, typer.Option("--allow-unauthenticated", help="let others in without LIGHTWELL_TOKEN")
    ] = False,
    scenes: Annotated[Path | None, typer.Option("--scenes", help="folder of scenes that clients may name")] = None,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", help="address of a Dask scheduler; default: a cluster of its own")
    ] = None,
    num_workers: Annotated[int | None, typer.Option("--workers", min=1, help="processes of the own cluster")] = None,
    preload: Annotated[
        list[str] | None,
        typer.Option("--preload", help="open this scene before /readyz says ready; may be given again"),
    ] = None,
    compile_: Annotated[
        bool,
        typer.Option("--compile", help="try compiled networks; the first frame of a size then takes tens of seconds"),
    ] = False,
) -> None:
    """Run jobs and answer frame requests over HTTP; /docs describes it. Also reads LIGHTWELL_* variables."""
    with reported():
        from service.config import load_config
        from service.serving import serve_store

        config = load_config(store_url=store, host=host, port=port, scenes_folder=scenes, scheduler=scheduler,
                             workers=num_workers, allow_unauthenticated=allow_unauthenticated or None,
                             compile=compile_ or None)  # fmt: skip
        serve_store(config, preload or ())


app.command()(verify)


@app.command()
def worker(
    scheduler: Annotated[str, typer.Option("--scheduler", help="address of a Dask scheduler, tcp://host:8786")],
    threads: Annotated[int, typer.Option("--threads", min=1, help="of a unit of bake, render or inputs")] = 1,
    train_threads: Annotated[int, typer.Option("--train-threads", min=0, help="of training; 0: all cores")] = 0,
    name: Annotated[str | None, typer.Option("--name", help="by which retries tell workers apart")] = None,
    memory_limit: Annotated[str, typer.Option("--memory-limit", help="such as 8GiB; auto: the machine's")] = "auto",
    folder: Annotated[str, typer.Option("--folder", help="for Dask's scratch files")] = tempfile.gettempdir(),
) -> None:
    """Work for a scheduler: one unit at a time, as many of these as the machine has cores for."""
    with reported():
        from service.worker_process import run_worker
        from workers.thread_policy import ThreadPolicy

        policy = ThreadPolicy(threads, train_threads or os.cpu_count() or 1)
        run_worker(scheduler, threads=policy, name=name, memory_limit=memory_limit, folder=folder)


app.command()(dataset)
app.command()(export)
app.command("cost-curves")(cost_curves)


def main() -> None:
    """Entry point of the `lightwell` script."""
    os.environ.setdefault("MPLBACKEND", "Agg")
    import workers  # noqa: F401  # sets the thread policy before anything imports torch

    app()


if __name__ == "__main__":
    main()
