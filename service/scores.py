"""The rows of an evaluation as people read them: columns, which way is better, refused scores, the best."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Column:
    """One score: its key in a row, its title, which way is better, and how it is written."""

    key: str
    title: str
    better: Literal["higher", "lower"]
    pattern: str

    @property
    def arrow(self) -> str:
        return "↑" if self.better == "higher" else "↓"


COLUMNS = (
    Column("psnr", "PSNR dB", "higher", "{:.2f}"),
    Column("ssim", "SSIM", "higher", "{:.4f}"),
    Column("flip", "FLIP", "lower", "{:.4f}"),
    Column("st_lpips", "ST-LPIPS", "lower", "{:.4f}"),
    Column("relmse", "relMSE", "lower", "{:.4g}"),
    Column("temporal", "temporal", "lower", "{:.4g}"),
    Column("ms", "ms", "lower", "{:.1f}"),
)
SCORES = tuple(column.key for column in COLUMNS if column.key != "ms")

REFUSED = "refused"
ABSENT = "-"
BELOW_REFERENCE_MARK = "≈"

METHOD_TITLES = {"ours": "ours (caches + network)", "ir": "caches alone (IR)", "ir+oidn": "caches + OIDN"}


def method_title(name: str) -> str:
    """A row's name as a reader sees it: "pt-4+oidn-fast" is path tracing at 4 spp, then OIDN fast."""
    if name in METHOD_TITLES:
        return METHOD_TITLES[name]
    traced, _, denoised = name.partition("+")
    if traced.startswith("pt-") and traced[3:].isdigit():
        title = f"path tracing {traced[3:]} spp"
        return f"{title} + {denoised.replace('oidn-', 'OIDN ')}" if denoised else title
    return name


def is_refused(row: Row) -> bool:
    """A frame with non-finite pixels gets no score (design: metrics, defined once)."""
    return bool(row.get("non_finite"))


def value(row: Row, column: Column) -> float | None:
    """The column's number, or None where it is refused, absent or not finite. A time is never refused."""
    number = row.get(column.key)
    if number is None or (is_refused(row) and column.key in SCORES):
        return None
    return float(number) if math.isfinite(number) else None


def is_below_reference(row: Row, column: Column, reference_error_db: float | None) -> bool:
    """Whether a PSNR claims a smaller error than the reference's own noise (such rows are equal)."""
    number = value(row, column)
    return (
        column.key == "psnr" and number is not None and reference_error_db is not None and number > reference_error_db
    )


def text(row: Row, column: Column, reference_error_db: float | None = None) -> str:
    """What stands in the cell."""
    number = value(row, column)
    if number is None:
        return REFUSED if is_refused(row) and column.key in SCORES else ABSENT
    mark = BELOW_REFERENCE_MARK if is_below_reference(row, column, reference_error_db) else ""
    return mark + column.pattern.format(number)


def best(rows: Iterable[Row], column: Column) -> float | None:
    """The best value of the column over all rows that have one."""
    numbers = [number for row in rows if (number := value(row, column)) is not None]
    if not numbers:
        return None
    return max(numbers) if column.better == "higher" else min(numbers)


def is_best(row: Row, column: Column, rows: Iterable[Row]) -> bool:
    """Whether the row holds the column's best value as written (equal texts are equally good)."""
    number, top = value(row, column), best(rows, column)
    return number is not None and top is not None and column.pattern.format(number) == column.pattern.format(top)


def human_bytes(num_bytes: float) -> str:
    """A size with its unit, in powers of 1024: 1536 is "1.5 KiB"."""
    for unit in ("B", "KiB", "MiB", "GiB"):
        if num_bytes < 1024:
            return f"{num_bytes:.0f} B" if unit == "B" else f"{num_bytes:.1f} {unit}"
        num_bytes /= 1024
    return f"{num_bytes:.1f} TiB"


def human_seconds(seconds: float) -> str:
    """A duration: "0.42 s", "12.0 s", "3 min 05 s", "2 h 07 min"."""
    if seconds < 60:
        return f"{seconds:.2f} s" if seconds < 10 else f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
