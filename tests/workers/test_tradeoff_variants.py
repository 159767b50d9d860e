"""What a sweep holds, before anything is computed."""

import pytest

from workers.errors import WorkerError
from workers.settings import Settings
from workers.tradeoff_variants import OURS, TradeoffBudget, affordable, sweep_variants

DRAFT = Settings.preset_named("draft")


def test_sweep_begins_with_the_base_and_varies_every_axis() -> None:
    rows = sweep_variants(DRAFT, TradeoffBudget())
    names = [row.name for row in rows]
    assert names[0] == OURS and len(set(names)) == len(names)
    changed = {key for row in rows for key in row.overrides}
    assert changed >= {"query.samples", "train.widths", "train.unshuffle", "cache.max_elements", "cache.diffuse_spp",
                       "cache.azimuth"}  # fmt: skip
    assert {row.scale for row in rows} == {1, 2}
    assert {row.precision for row in rows} >= {"fp32", "bf16"}
    (paper,) = (row for row in rows if row.kind == "paper")
    exact = DRAFT.override(paper.overrides)
    assert (exact.cache.azimuth, exact.cache.polar, exact.cache.directional_spp) == (64, 16, 32)
    assert (exact.train.batch, exact.train.perceptual_every, exact.train.schedule) == (2, 1, "paper")
    assert all(row.kind == "ours" for row in sweep_variants(DRAFT, TradeoffBudget(paper=False)))


@pytest.mark.parametrize("preset", ["draft", "balanced", "reference", "tiny"])
def test_every_variant_has_settings_that_are_allowed(preset: str) -> None:
    settings = Settings.preset_named(preset)
    for row in sweep_variants(settings, TradeoffBudget()):
        settings.override(row.overrides)


def test_variant_that_the_preset_already_is_is_left_out() -> None:
    names = [row.name for row in sweep_variants(DRAFT.override({"query.samples": 1}), TradeoffBudget())]
    assert "1x1 query" not in names and "no network, 1x1 query" not in names
    assert {"half scale", "no network"} <= set(names)
    narrow = [row.name for row in sweep_variants(Settings.preset_named("tiny"), TradeoffBudget())]
    assert "narrow network" not in narrow and "wide network" in narrow


def test_affordable_training_is_the_shorter_one() -> None:
    budget = TradeoffBudget(network_seconds=50.0)
    assert affordable(DRAFT, budget).train.seconds == 50.0
    assert affordable(DRAFT.override({"train.seconds": 20.0}), budget).train.seconds == 20.0
    assert affordable(DRAFT.override({"train.seconds": 0.0}), budget).train.seconds == 50.0  # 0 is no limit


@pytest.mark.parametrize("values", [{"network_seconds": 0.0}, {"repeats": 0}, {"network_seconds": float("inf")}])
def test_budget_that_is_none_is_refused(values: dict[str, float]) -> None:
    with pytest.raises(WorkerError, match="must be above 0"):
        TradeoffBudget(**values)  # type: ignore[arg-type]
