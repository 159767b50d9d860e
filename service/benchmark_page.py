"""The benchmarks' page: Markdown from the records of `service/benchmarks.py`, in a stable order."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from service import scores, trade, tradeoff
from service.ablations import HEAD, LEGEND, ablation_cells, requirement
from service.cost_curves import CURVES, exponent_cells, exponent_head, kind_title, remarks, row_cells, sentence
from service.cost_curves import HEAD as CURVES_HEAD
from service.scores import human_bytes, human_seconds

Record = Mapping[str, Any]

PARTS = (
    ("primary", "primary rays alone (1 a pixel)"),
    ("query-1x1", "query with G-buffers, 1x1"),
    ("query", "query with G-buffers, {samples}x{samples}{where} (this run)"),
    ("network", "network"),
    ("frame", "**whole frame**"),
    ("pt-1", "path tracing, 1 spp"),
    ("oidn-fast", "OIDN fast, alone"),
    ("oidn-balanced", "OIDN balanced, alone"),
    ("oidn-high", "OIDN high, alone"),
)
BUSY_SHARE = 0.1  # of the CPU threads: above, the page says that the machine was not idle
INTRODUCTION = """\
# Benchmarks

This page is written by `lightwell benchmark` (`make benchmarks`) from what it measured; do not edit it.
Every section names the command, commit and machine that gave it.

- One exposure a scene: e = 0.6 / P80(luminance of the training references). PSNR, SSIM, FLIP and ST-LPIPS
  on sRGB(clip(e L, 0, 1)); relMSE on e L. "temporal" is the warped difference between consecutive frames that
  the reference does not have. A frame with non-finite pixels gets no score ("refused").
- ours: caches and network. ir: the caches alone. ir+oidn: the caches denoised, no network. pt-N: N paths a
  pixel. pt-N+oidn-Q: the same, denoised by Open Image Denoise (OIDN) at quality Q with albedo and normal.
- Times are medians of interleaved runs, each right after one that does not count. All rows go from a pose to a frame
  in memory.
"""


def render_page(records: Sequence[Record], curves: Sequence[Record] = (), trades: Sequence[Record] = ()) -> str:
    """The whole page: scenes, then tradeoffs and cost curves."""
    if not records and not curves and not trades:
        return f"{INTRODUCTION}\nNo scene has been measured yet.\n"
    lines = [INTRODUCTION]
    if records:
        lines += [*_summary(records), *(_section(record) for record in records)]
    return "\n".join([*lines, *_trades(trades), *_cost_curves(curves)])


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    """A Markdown table: the first column to the left, the others to the right; ends with an empty line."""
    titles = [_cell(title) for title in head]
    lines = [f"| {' | '.join(titles)} |", f"| --- |{' ---: |' * (len(titles) - 1)}"]
    return [*lines, *(f"| {' | '.join(_cell(cell) for cell in row)} |" for row in rows), ""]


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())


def _signed(number: float | None, pattern: str = "{:+.2f}") -> str:
    return scores.ABSENT if number is None else pattern.format(number)


def _summary(records: Sequence[Record]) -> list[str]:
    head = ("scene", "ours, PSNR dB", f"over {trade.ONE_SAMPLE}, dB", "its time, ours = 1",
            "network's gain, dB", "over ir+oidn, dB", "references' own noise, dB")  # fmt: skip
    rows = []
    for record in records:
        result = record["result"]
        measured = result["rows"]
        own = next(row for row in measured if row["name"] == trade.OURS)
        ratio = trade.time_ratio(measured, trade.ONE_SAMPLE)
        error_db = result.get("reference_error_db")
        rows.append([
            f"[{record['scene']}](#{record['scene']})", scores.text(own, scores.COLUMNS[0], error_db),
            _signed(trade.gain(measured, trade.ONE_SAMPLE, "psnr")),
            scores.ABSENT if ratio is None else f"{1 / ratio:.2f}",
            _signed(trade.gain(measured, trade.CACHES, "psnr")),
            _signed(trade.gain(measured, trade.CACHES_DENOISED, "psnr")),
            scores.ABSENT if error_db is None else f"{error_db:.2f}",
        ])  # fmt: skip
    return table(head, rows)


def _section(record: Record) -> str:
    result = record["result"]
    shown = f"`{record['source']}`, {result['width']}x{result['height']}, preset {result.get('preset', '?')}."
    lines = [f"## {record['scene']}", "", shown, "", " ".join(trade.sentences(result)), ""]
    lines += _provenance(record)
    lines += ["### Frames", "", *_frames(result)]
    lines += ["### Stages and sizes", "", *_stages(result)]
    lines += _frame_times(record["frame_times"])
    lines += _bake(record["bake"])
    for key, title in (("ablation", "Ablation"), ("selection", "Ablation, selected rows")):
        if key in record:
            lines += _ablation(record, record[key], title)
    return "\n".join(lines)


def _provenance(record: Record) -> list[str]:
    machine = record["machine"]
    if isinstance(machine, Mapping):
        machine = ", ".join(f"{key} {value}" for key, value in machine.items())
    lines = ["```sh", record["command"], "```", "", f"Commit {record['commit']}; {machine}.", ""]
    load = record.get("load")
    if load and load["other_cpus"] > BUSY_SHARE * load["cpus"]:
        lines += [f"**Other processes kept {load['other_cpus']:.1f} of {load['cpus']:.0f} CPU threads busy "
                  "meanwhile: the times are longer than this machine needs.**", ""]  # fmt: skip
    return lines


def _frames(result: Mapping[str, Any]) -> list[str]:
    error_db, rows = result.get("reference_error_db"), result["rows"]
    head = ["frame", *(f"{column.title} {column.arrow}" for column in scores.COLUMNS), "non-finite"]
    cells = [
        [row["name"], *(_score(row, column, rows, error_db) for column in scores.COLUMNS),
         str(row.get("non_finite", scores.ABSENT))]
        for row in rows
    ]  # fmt: skip
    lines = table(head, cells)
    if error_db is not None:
        denoised = "denoised before use" if result.get("reference_denoised") else "used as rendered"
        lines += [
            f"The references' own noise: {error_db:.2f} dB, {denoised}; a PSNR above it is marked "
            f"{scores.BELOW_REFERENCE_MARK}: such rows cannot be told apart. Bold: best of its column.",
            "",
        ]
    notes = result.get("notes", ())
    return [*lines, *(f"- {_cell(note)}" for note in notes), *([""] if notes else [])]


def _score(row: scores.Row, column: scores.Column, rows: Sequence[scores.Row], error_db: float | None) -> str:
    text = scores.text(row, column, error_db)
    return f"**{text}**" if scores.is_best(row, column, rows) else text


def _stages(result: Mapping[str, Any]) -> list[str]:
    stages = result["stages"]
    rows = [[stage["name"], human_seconds(stage["seconds"])] for stage in stages]
    rows.append(["**all**", human_seconds(sum(stage["seconds"] for stage in stages))])
    sizes = f"Caches {human_bytes(result['cache_nbytes'])}, network {human_bytes(result['network_nbytes'])}."
    if result.get("coverage") is not None:
        sizes += f" Baked elements answered {100 * result['coverage']:.2f} % of the lookups of the test path."
    if all("bake" not in stage["name"] for stage in stages):
        sizes += " The seconds of stages that were in the store before the first benchmark are not known."
    return [*table(("stage", "time"), rows), sizes, ""]


def _frame_times(times: Mapping[str, Any]) -> list[str]:
    ms, network = times["ms"], times["network"]
    where = " at edges" if times.get("supersample") == "edges" else ""
    rows = [
        [title.format(samples=times["samples"], where=where), f"{ms[key]:.1f}"] for key, title in PARTS if key in ms
    ]
    peaks = network["peak_gflop_per_s"]
    peak_text = ", ".join(f"{name} {rate:.0f} GFLOP/s" for name, rate in peaks.items())
    ratios = "; ".join(f"{name}: {ratio:.2f}" for name, ratio in times["ratios"].items())
    return [
        f"### Time of a {times['width']}x{times['height']} frame", "",
        f"From the scene's own view; medians of {times['repeats']} interleaved rounds.", "",
        *table(("part", "ms"), rows),
        f"Ratios: {ratios}.", "",
        f"The network ({network['choice']}, {network['threads']} threads) computes {network['gflop']:.2f} "
        f"GFLOP at {network['gflop_per_s']:.0f} GFLOP/s: {100 * network['share']:.0f} % of the "
        f"{network['choice'].split()[0]} peak measured here with a large matrix product ({peak_text}).", "",
    ]  # fmt: skip


def _bake(bake: Mapping[str, Any]) -> list[str]:
    rates, ratios = bake["paths_per_s"], bake["ratios"]
    rows = [
        [
            name,
            f"{rate / 1e6:.2f}",
            f"{ratios[name]:.2f}" if name in ratios else "1",
            f"{bake['paths'][name]:,}",
        ]
        for name, rate in rates.items()
    ]
    depth = "unlimited" if bake["max_depth"] < 0 else bake["max_depth"]
    return [
        "### Throughput of the bake", "",
        f"Whole launches of the bake's kernels against Mitsuba's `path` integrator from the scene's own "
        f"view, longest path {depth}; medians of {bake['repeats']} interleaved rounds, warm."
        + (" Paths of `diffuse-traced` go to their end as Mitsuba's do; those of the other sets end where they meet a "
           "diffuse cache." if "diffuse-traced" in rates else ""), "",
        *table(("paths from", "M paths/s", "ratio", "paths a launch"), rows),
    ]  # fmt: skip


def _trades(trades: Sequence[Record]) -> list[str]:
    if not trades:
        return []
    lines = ["## Tradeoffs", "", f"Fastest first. {tradeoff.LEGEND}", ""]
    for record in trades:
        result, scene = record["result"], record["scene"]
        lines += [f"### {scene}: tradeoff", ""]
        lines += [f"{result['width']}x{result['height']}, preset {result['preset']}. {tradeoff.dominance(result)}", ""]
        lines += ["```sh", record["command"], "```", "", f"Commit {result['commit']}.", ""]
        lines += table(tradeoff.HEAD, (tradeoff.tradeoff_cells(row) for row in tradeoff.by_time(result["rows"])))
        lines += [f"![{scene}: error against time, bake and bytes]({tradeoff.TRADES.folder}/{scene}.png)", ""]
        lines += [*(f"- {_cell(remark.removeprefix('note: '))}" for remark in tradeoff.remarks(result)), ""]
    return lines


def _cost_curves(curves: Sequence[Record]) -> list[str]:
    if not curves:
        return []
    lines = ["## Cost curves", "", "Costs against the number of triangles, n, of one scene.", ""]
    for record in curves:
        result = record["result"]
        shown = f"{result['width']}x{result['height']}, preset {result['preset']}; {result['triangles']:,} triangles "
        shown += f"in the file; ours within {result['max_elements']:,} elements."
        lines += [f"### {record['scene']}: costs", "", f"{shown} {sentence(result)}", ""]
        lines += ["```sh", record["command"], "```", "", f"Commit {result['commit']}.", ""]
        for kind in dict.fromkeys(row["kind"] for row in result["rows"]):
            own = [row for row in result["rows"] if row["kind"] == kind]
            head = [f"triangles, {kind_title(kind)}", *CURVES_HEAD[1:]]
            lines += table(head, (row_cells(row) for row in own))
        fits = result["exponents"]
        lines += table(exponent_head(fits), exponent_cells(fits))
        lines += [f"![{record['scene']}: costs against triangles]({CURVES.folder}/{record['scene']}.png)", ""]
        lines += [*(f"- {_cell(remark.removeprefix('note: '))}" for remark in remarks(result)), ""]
    return lines


def _ablation(record: Record, ablation: Record, title: str) -> list[str]:
    shown = f"{ablation['width']}x{ablation['height']}, preset {ablation['preset']}. {LEGEND}"
    lines = [f"### {title}", "", shown, "", *table(HEAD, ablation_cells(ablation["rows"]))]
    said = requirement(ablation["rows"])
    lines += [said, ""] if said else []
    same = all(ablation[key] == record[key] for key in ("command", "commit", "machine"))
    return lines if same else lines + _provenance(ablation)
