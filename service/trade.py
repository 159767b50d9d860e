"""What an evaluation's numbers say, in sentences: where ours wins, where it loses, and what cannot be told.

Every sentence is computed from the rows; none is written by hand, so a loss reads as plainly as a win.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from service.scores import COLUMNS, Column, Row, is_refused, value

OURS, CACHES, CACHES_DENOISED, ONE_SAMPLE = "ours", "ir", "ir+oidn", "pt-1+oidn-high"
REFERENCE_MARGIN_DB = 3.0
_COLUMN = {column.key: column for column in COLUMNS}
_PSNR, _FLIP, _MS = _COLUMN["psnr"], _COLUMN["flip"], _COLUMN["ms"]


def sentences(result: Mapping[str, Any]) -> list[str]:
    """The trade in words.

    Args:
        result: an evaluation's result JSON.

    Returns:
        One sentence each; rows without a score or time are not compared.
    """
    rows = {row["name"]: row for row in result["rows"]}
    ours = rows.get(OURS)
    if ours is None or is_refused(ours):
        count = ours["non_finite"] if ours else "no"
        return [f"Our frames get no score ({count} non-finite values): nothing is compared."]
    if value(ours, _PSNR) is None or value(ours, _MS) is None:
        return ["Our frames have no PSNR or no time: nothing is compared."]
    parts: list[str | None] = [
        _equal_time(ours, _denoised(rows.values())),
        _cheapest_better(ours, _denoised(rows.values())),
        _against(ours, rows.get(ONE_SAMPLE)),
        _network_gain(ours, rows.get(CACHES)),
        _against(ours, rows.get(CACHES_DENOISED)),
        _reference(ours, result),
    ]
    return [part for part in parts if part]


def gain(rows: Iterable[Row], name: str, key: str) -> float | None:
    """Ours minus the named row in a score (sign as the numbers are); None where either has none."""
    found = {row["name"]: value(row, _COLUMN[key]) for row in rows if row["name"] in (OURS, name)}
    ours, other = found.get(OURS), found.get(name)
    return None if ours is None or other is None else ours - other


def time_ratio(rows: Iterable[Row], name: str) -> float | None:
    """Our frame's time over the named row's; None where either has none."""
    found = {row["name"]: value(row, _MS) for row in rows if row["name"] in (OURS, name)}
    ours, other = found.get(OURS), found.get(name)
    return None if ours is None or not other else ours / other


def _denoised(rows: Iterable[Row]) -> list[Row]:
    """Path-traced, denoised rows with a score and a time, fastest first."""
    kept = [
        row
        for row in rows
        if row["name"].startswith("pt-")
        and "+oidn" in row["name"]
        and value(row, _PSNR) is not None
        and value(row, _MS) is not None
    ]
    return sorted(kept, key=lambda row: row["ms"])


def _better(ours: Row, row: Row) -> str:
    """ "ours is 1.20 dB better in PSNR and 0.0100 worse in FLIP"."""
    parts = []
    for column, unit in ((_PSNR, " dB"), (_FLIP, "")):
        a, b = value(ours, column), value(row, column)
        if a is not None and b is not None:
            parts.append(_difference(a - b, column, unit))
    return "ours is " + " and ".join(parts)


def _difference(difference: float, column: Column, unit: str) -> str:
    size = column.pattern.format(abs(difference))
    if float(size) == 0.0:
        return f"equal in {column.title.split()[0]}"
    wins = (difference > 0) == (column.better == "higher")
    return f"{size}{unit} {'better' if wins else 'worse'} in {column.title.split()[0]}"


def _equal_time(ours: Row, denoised: list[Row]) -> str | None:
    if not denoised:
        return None
    as_fast = [row for row in denoised if row["ms"] <= ours["ms"]]
    own = f"our frame ({ours['ms']:.1f} ms)"
    if not as_fast:
        first = denoised[0]
        return (
            f"At equal time: no denoised path-traced row is as fast as {own}; the fastest, {first['name']}, "
            f"takes {first['ms'] / ours['ms']:.2f} times as long, and {_better(ours, first)}."
        )
    names = ", ".join(row["name"] for row in as_fast)
    text = f"At equal time: {names} take{'s' if len(as_fast) == 1 else ''} no more time than {own}"
    keys: list[Callable[[Row], float]] = [lambda row: -row["psnr"]]
    if all(value(row, _FLIP) is not None for row in as_fast):
        keys.append(lambda row: row["flip"])
    tops = [min(as_fast, key=key) for key in keys]
    text += f"; against the best of them in PSNR, {tops[0]['name']}, {_better(ours, tops[0])}"
    if tops[-1]["name"] != tops[0]["name"]:
        text += f"; against the best in FLIP, {tops[-1]['name']}, {_better(ours, tops[-1])}"
    return text + "."


def _cheapest_better(ours: Row, denoised: list[Row]) -> str | None:
    if not denoised:
        return None
    better = [row for row in denoised if row["psnr"] > ours["psnr"]]
    if not better:
        return "No denoised path-traced row that was measured has a higher PSNR than ours."
    first = better[0]
    return (
        f"The fastest denoised row with a higher PSNR than ours is {first['name']}: "
        f"{first['psnr'] - ours['psnr']:.2f} dB more, in {first['ms'] / ours['ms']:.2f} times our time."
    )


def _against(ours: Row, row: Row | None) -> str | None:
    if row is None or value(row, _PSNR) is None or value(row, _MS) is None:
        return None
    return f"Against {row['name']}: {_better(ours, row)}, in {ours['ms'] / row['ms']:.2f} times its time."


def _network_gain(ours: Row, caches: Row | None) -> str | None:
    if caches is None or value(caches, _PSNR) is None or value(caches, _MS) is None:
        return None
    difference = ours["psnr"] - caches["psnr"]
    verb = "adds" if difference >= 0 else "takes"
    direction = "to" if difference >= 0 else "from"
    return (
        f"The network {verb} {abs(difference):.2f} dB {direction} the caches alone "
        f"(ir: {caches['psnr']:.2f} dB in {caches['ms']:.1f} ms)."
    )


def _reference(ours: Row, result: Mapping[str, Any]) -> str | None:
    error_db = result.get("reference_error_db")
    if error_db is None:
        return None
    text = f"The raw references' own noise would score {error_db:.2f} dB"
    if result.get("reference_denoised"):
        text += ", so they were denoised, which favours every row that uses the same denoiser"
    if ours["psnr"] > error_db - REFERENCE_MARGIN_DB:
        margin = f"{REFERENCE_MARGIN_DB:.0f} dB"
        text += f"; our PSNR is above or within {margin} of that: small differences mean nothing"
    return text + "."
