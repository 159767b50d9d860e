"""`lightwell export`: a scene's network as an ONNX file."""

from pathlib import Path
from typing import Annotated

import typer

from service.errors import OptionError
from service.failures import reported
from service.options import check_writable, write_file


def export(
    scene: Annotated[str, typer.Argument(help="the scene's file, or its name or digest in the store")],
    store: Annotated[str, typer.Option("--store", help="folder or URL that a run has filled")],
    output: Annotated[Path, typer.Option("--output", "-o", help="an .onnx file")],
    tolerance: Annotated[
        float, typer.Option("--tolerance", min=0.0, help="largest difference to PyTorch, in exposed radiance")
    ] = 1e-4,
) -> None:
    """Write the trained network as ONNX (features in, linear radiance out), checked against PyTorch."""
    with reported():
        if output.suffix.lower() != ".onnx":
            raise OptionError(f"--output must be an .onnx file, got {str(output)!r}")
        check_writable(output, "--output")
        from service.progress import RichProgress
        from storage.store import Store

        opened = Store.open(store)
        from workers.export import export_scene
        from workers.scene import load_scene

        with RichProgress() as progress, progress.busy("export and check"):
            name = load_scene(scene).digest if Path(scene).is_file() else scene
            exported = export_scene(opened, name, tolerance=tolerance)
        write_file(output, exported.data)
        print(f"{output}: {len(exported.data) / 1e6:.2f} MB, within {exported.error:.2g} of PyTorch in exposed "
              f"radiance on {exported.num_pixels} pixels of queried features (tolerance {tolerance:g})")  # fmt: skip
