"""What an evaluation leaves: the table on the terminal, the JSON, the report, a picture, the next step."""

import json
import math
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.options import check_writable, look_at_text, write_file

if TYPE_CHECKING:
    from workers.camera import Camera
    from workers.pipeline import Evaluation

REPORTS_FOLDER = "reports"


def json_values(value: Any) -> Any:
    """The value with infinities and NaN as None: JSON has no words for them."""
    if isinstance(value, dict):
        return {str(key): json_values(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_values(item) for item in value]
    if hasattr(value, "item"):  # numpy's scalars
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def default_report(store_url: str, scene: str, width: int, height: int) -> Path:
    """Where the report goes when nobody says: into a local store's folder, else into the working folder."""
    name = f"{scene}-{width}x{height}.html"
    if "://" in store_url:
        return Path(f"lightwell-{name}")
    return Path(store_url) / REPORTS_FOLDER / name


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """Files that a command was asked to write; None is "not given", and then only the report is written.

    Raises:
        OptionError: a file that was asked for cannot be written.
    """

    json: Path | None = None
    report: Path | None = None
    picture: Path | None = None

    def __post_init__(self) -> None:
        for option in ("json", "report", "picture"):
            path = getattr(self, option)
            if path is not None:
                check_writable(path, f"--{option}")


def finish(evaluation: "Evaluation", store_url: str, outputs: Outputs) -> Path:
    """Prints the table, writes the files, and returns where the report lies."""
    from service.report import contact_sheet, render_report
    from service.table import score_table, show

    result = evaluation.result
    show(score_table(result))
    report = outputs.report or default_report(store_url, result["scene"], result["width"], result["height"])
    command = shlex.join(["lightwell", *sys.argv[1:]])
    write_file(report, render_report(evaluation, command=command).encode())
    if outputs.json is not None:
        text = json.dumps(json_values(result), indent=2, allow_nan=False)
        write_file(outputs.json, f"{text}\n".encode())
    if outputs.picture is not None and evaluation.pictures:
        write_file(outputs.picture, contact_sheet(evaluation.pictures[0]))
    print(f"report: {report.resolve()}")
    return report


def frame_request_lines(scene: str, store_url: str, camera: "Camera") -> list[str]:
    """How to ask for a frame from the scene's own camera, with curl and without a server."""
    numbers = [float(number) for number in look_at_text(camera).split(",")]
    look_at = {"origin": numbers[:3], "target": numbers[3:6], "up": numbers[6:]}
    body = json.dumps({"camera": {"look_at": look_at}, "fov_deg": round(camera.fov_deg, 4),
                       "width": camera.width, "height": camera.height})  # fmt: skip
    store = shlex.quote(store_url)
    return [
        f"lightwell serve --store {store} & sleep 5; curl -sS -H 'Content-Type: application/json' "
        f"-d '{body}' http://127.0.0.1:8000/v1/scenes/{scene}/frame -o frame.png",
        f"lightwell frame {scene} --store {store} --look-at={look_at_text(camera)} "
        f"--fov {camera.fov_deg:.4g} --size {camera.width}x{camera.height} -o frame.png",
    ]
