"""The evaluation as one HTML file that needs nothing else: scores, the trade as a plot, pictures."""

import base64
import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from service import images, plot, scores
from service.table import remarks

if TYPE_CHECKING:
    from workers.pipeline import Evaluation, Picture

MAX_PNG_PX = 512 * 512
"""Larger pictures are embedded as JPEG: a page of 1080p PNG pictures would be hundreds of megabytes."""

FLIP_COLOUR_MAP = "magma"
PICTURE_ORDER = ("ir", "ours")


def data_uri(pixels: NDArray[np.uint8]) -> str:
    """[height, width, 3] sRGB in 8 bits as a data: address for an <img>."""
    media_type = images.PNG if pixels.shape[0] * pixels.shape[1] <= MAX_PNG_PX else images.JPEG
    encoded = base64.b64encode(images.encode_pixels(pixels, media_type)).decode("ascii")
    return f"data:{media_type};base64,{encoded}"


def flip_pixels(flip_map: NDArray[np.float32]) -> NDArray[np.uint8]:
    """[height, width] FLIP error in 0..1 (clipped to it) as [height, width, 3] colours, black to yellow."""
    from matplotlib import colormaps

    coloured = colormaps[FLIP_COLOUR_MAP](np.clip(flip_map, 0.0, 1.0), bytes=True)
    return np.ascontiguousarray(coloured[..., :3])


def picture_order(labels: list[str]) -> list[str]:
    """Input caches first, then ours, then the others as given, the reference last."""
    last = [label for label in labels if label == "reference"]
    first = [label for label in PICTURE_ORDER if label in labels]
    return first + [label for label in labels if label not in first and label not in last] + last


def contact_sheet(picture: "Picture", labels: list[str] | None = None, gap_px: int = 4) -> bytes:
    """The picture's images side by side as one PNG, in `picture_order` unless `labels` says otherwise."""
    order = labels or picture_order(list(picture.images))
    tiles = [images.display_image(picture.images[label], picture.exposure) for label in order]
    gap = np.full((tiles[0].shape[0], gap_px, 3), 255, np.uint8)
    row = [part for tile in tiles for part in (gap, tile)][1:]
    return images.encode_pixels(np.concatenate(row, axis=1))


def _tiles(picture: "Picture", rows: Mapping[str, scores.Row]) -> list[dict[str, Any]]:
    """One figure an image: its address, its FLIP map's address (or None) and its caption."""
    tiles = []
    for label in picture_order(list(picture.images)):
        radiance = picture.images[label]
        flip_map = picture.flip_maps.get(label)
        tiles.append(
            {
                "title": scores.method_title(label),
                "is_ours": label == "ours",
                "width": radiance.shape[1],
                "height": radiance.shape[0],
                "image": data_uri(images.display_image(radiance, picture.exposure)),
                "flip": None if flip_map is None else data_uri(flip_pixels(flip_map)),
                "flip_mean": None if flip_map is None else float(np.mean(flip_map)),
                "row": rows.get(label),
            }
        )
    return tiles


def _table(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The score table's rows: title and cells with the classes that style them."""
    rows = result["rows"]
    table = []
    for row in rows:
        cells = []
        for column in scores.COLUMNS:
            text = scores.text(row, column, result.get("reference_error_db"))
            refused = text == scores.REFUSED
            style = "refused" if refused else "best" if scores.is_best(row, column, rows) else ""
            cells.append({"text": text, "style": style})
        table.append({"name": row["name"], "title": scores.method_title(row["name"]), "cells": cells,
                      "non_finite": row.get("non_finite", scores.ABSENT)})  # fmt: skip
    return table


def _stages(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    stages = result.get("stages", [])
    total_s = sum(stage["seconds"] for stage in stages) or 1.0
    return [
        {
            "name": stage["name"],
            "time": scores.human_seconds(stage["seconds"]),
            "share": stage["seconds"] / total_s,
        }
        for stage in stages
    ]


def _facts(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Name and value of everything else that the result tells, in its own order."""
    shown = {"rows", "stages", "notes", "settings", "scene", "width", "height"}
    facts = []
    for key, value in result.items():
        if key in shown or value is None:
            continue
        name = key.replace("_", " ")
        if key.endswith("_nbytes"):
            name, value = name.removesuffix(" nbytes"), scores.human_bytes(value)
        elif isinstance(value, Mapping):
            value = "; ".join(f"{k}: {v}" for k, v in value.items())
        elif isinstance(value, float):
            value = f"{value:.4g}"
        facts.append((name, str(value)))
    return facts


def render_report(evaluation: "Evaluation", *, command: str | None = None) -> str:
    """The page.

    Args:
        evaluation: scores and pictures of one run.
        command: the command line that made it, shown so that a reader can repeat it.

    Returns:
        HTML with everything inline: styles, plot, and pictures as data: addresses.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    result = evaluation.result
    environment = Environment(
        loader=PackageLoader("service"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    rows = {row["name"]: row for row in result["rows"]}
    return environment.get_template("report.html").render(
        result=result,
        columns=scores.COLUMNS,
        table=_table(result),
        stages=_stages(result),
        facts=_facts(result),
        remarks=remarks(result),
        settings=json.dumps(result.get("settings", {}), indent=2, default=str),
        pictures=[{"title": picture.title, "tiles": _tiles(picture, rows)} for picture in evaluation.pictures],
        plot=plot.trade_plot(result),
        frame=plot,
        command=command,
    )
