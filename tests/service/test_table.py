"""Terminal tables, printed into a string."""

import io
import re
from typing import Any

from rich.console import Console

from service.table import plan_table, remarks, score_table, show


def printed(renderable: Any, *, colours: bool = False) -> str:
    console = Console(
        file=io.StringIO(), width=160, force_terminal=colours, color_system="standard" if colours else None
    )
    console.print(renderable)
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_score_table_has_a_line_for_every_row(evaluation: Any) -> None:
    lines = printed(score_table(evaluation.result)).splitlines()
    ours = next(line for line in lines if "ours" in line)
    assert [cell.strip() for cell in ours.split("│")[1:4]] == ["ours", "≈34.25", "0.9000"]
    refused = next(line for line in lines if "pt-4+oidn-high" in line)
    assert refused.count("refused") == 6 and "400.0" in refused and "99" not in refused


def test_score_table_makes_the_best_value_bold(evaluation: Any) -> None:
    text = printed(score_table(evaluation.result), colours=True)
    best = re.findall(r"\x1b\[1;32m *(\S+?)\x1b", text)
    assert best[0] == "≈34.25" and "3.0" in best and "28.00" not in best


def test_score_table_does_not_read_markup_in_names(evaluation: Any) -> None:
    evaluation.result["scene"] = evaluation.result["rows"][0]["name"] = "[red]x[/nonsense]"
    assert printed(score_table(evaluation.result)).count("[red]x[/nonsense]") == 2


def test_remarks_tell_sizes_noise_and_notes(evaluation: Any) -> None:
    assert remarks(evaluation.result) == [
        "caches 3.0 MiB; network 1.5 KiB; all stages 2 min 00 s",
        "the reference's own noise: 33.00 dB; a PSNR above it is marked ≈, such rows cannot be told apart",
        "note: the reference was denoised",
    ]
    assert remarks({"rows": []}) == ["all stages 0.00 s"]


def test_plan_table_shows_choice_reason_and_cost() -> None:
    rows = [{"item": "directions", "choice": "32x8", "reason": "rough gold [0.2]"}]
    text = printed(plan_table({"rows": rows, "cost": {"paths": 2.5e8, "seconds": 125, "nbytes": 2**20}}))
    assert "rough gold [0.2]" in text and "cost: 2.5e+08 paths, about 2 min 05 s, 1.0 MiB" in text


def test_plan_table_shows_both_costs_where_the_plan_differs_from_the_settings() -> None:
    cheap, dear = ({"paths": 1e6, "seconds": seconds, "nbytes": 1024} for seconds in (30, 60))
    plan = {"rows": [], "cost": dear, "planned_cost": cheap, "preset_cost": dear}
    text = printed(plan_table(plan))
    assert "as planned (run --planned): 1e+06 paths, about 30.0 s" in text and "as given: 1e+06 paths" in text
    assert "as planned" not in printed(plan_table({**plan, "planned_cost": dear}))


def test_show_keeps_columns_whole_where_there_is_no_terminal(evaluation: Any) -> None:
    narrow = Console(file=io.StringIO(), width=40)
    show(score_table(evaluation.result), narrow)
    assert "pt-1+oidn-high" in narrow.file.getvalue()  # type: ignore[attr-defined]
    assert "…" not in narrow.file.getvalue()  # type: ignore[attr-defined]
