"""Plans of units: what depends on what, groups, resuming, and the price of a million."""

import time
import tracemalloc

import pytest

from workers.job_spec import JobSpec, JobSpecError
from workers.units import (
    Block,
    Census,
    Inventory,
    LobeInventory,
    blocks_after_census,
    blocks_after_inventory,
    by_priority,
)

CENSUS = Census("d1", "e1", {"train": ("r0", "r1"), "validation": ("v0",), "test": ("t0", "t1")})
LOBES = {"diffuse": LobeInventory("b0", 100, 1 << 20), "directional": LobeInventory("b1", 3, 1 << 30, after="diffuse")}
INVENTORY = Inventory(LOBES, {"train": ("i0", "i1"), "validation": ("j0",)})
FRAMES = {"render train", "render validation", "render test"}
INPUTS = {"inputs train", "inputs validation"}


def plan(last_stage: str) -> dict[str, Block]:
    blocks = blocks_after_census(CENSUS, last_stage) + blocks_after_inventory(CENSUS, INVENTORY, last_stage)
    return {block.name: block for block in blocks}


def test_plan_of_a_whole_run_names_every_dependency() -> None:
    blocks = plan("evaluate")
    needs = {name: set(block.needs) for name, block in blocks.items()}
    assert needs["elements"] == needs["render test"] == {"census"}
    assert needs["bake diffuse"] == {"inventory"}
    assert needs["seal diffuse"] == {"bake diffuse"}
    assert needs["bake directional"] == {"inventory", "seal diffuse"}
    assert needs["inputs train"] == {"inventory", "seal diffuse", "seal directional"}
    assert needs["train"] == {"inputs train", "inputs validation", "render train", "render validation"}
    assert needs["evaluate"] == {"train", "render test"}
    ordered = [block.name for block in sorted(blocks.values(), key=by_priority)]
    assert ordered.index("bake diffuse") < ordered.index("inputs train") < ordered.index("render train")


@pytest.mark.parametrize(
    ("last_stage", "absent"),
    [("bake", FRAMES | INPUTS | {"train", "evaluate"}), ("render", INPUTS | {"train", "evaluate"}),
     ("train", {"evaluate"})],
)  # fmt: skip
def test_plan_ends_with_the_last_stage(last_stage: str, absent: set[str]) -> None:
    assert plan("evaluate").keys() - plan(last_stage).keys() == absent


def test_plan_without_validation_or_lobes_leaves_their_blocks_out() -> None:
    census = Census("d1", "e1", {"train": ("r0",), "validation": (), "test": ("t0",)})
    inventory = Inventory({}, {"train": ("i0",), "validation": ()})
    blocks = {b.name: b for b in blocks_after_inventory(census, inventory, "evaluate")}
    assert blocks["inputs train"].needs == ("inventory",)
    assert blocks["train"].needs == ("inputs train", "render train")
    assert "render validation" not in {b.name for b in blocks_after_census(census, "evaluate")}


def test_group_holds_some_seconds_of_work_but_leaves_enough_tasks_to_share() -> None:
    assert LOBES["diffuse"].group == 6  # 100 units in at least 16 tasks
    assert LOBES["directional"].group == 1  # one unit is already more than a task's paths
    assert LobeInventory("b", 10_000, 1 << 20).group == 8


def test_block_covers_every_member_once() -> None:
    block = Block("bake", "diffuse", total=100, group=7, keys=("k",))
    members = [m for unit in block.pending(()) for m in range(unit.first, unit.first + unit.count)]
    assert members == list(range(100))
    assert len(block) == 15
    with pytest.raises(IndexError):
        block[15]


def test_block_pends_only_groups_that_lack_a_member() -> None:
    block = Block("bake", "diffuse", total=20, group=5, keys=("k",))
    done = set(range(20)) - {7, 19}
    assert [(unit.first, unit.count) for unit in block.pending(done)] == [(5, 5), (15, 5)]
    frames = Block("render", "train", 3, keys=("a", "b", "c"))
    assert [(unit.name, unit.key) for unit in frames.pending({1})] == [("render train 0", "a"), ("render train 2", "c")]


def count_of(num_bake_units: int) -> int:
    """Plans a run from its keys and hands out every unit."""
    lobes = {"diffuse": LobeInventory("b0", num_bake_units, 1 << 24)}
    inventory = Inventory(lobes, INVENTORY.inputs)
    blocks = blocks_after_census(CENSUS, "evaluate") + blocks_after_inventory(CENSUS, inventory, "evaluate")
    return sum(1 for block in blocks for _ in block.pending(()))


def test_plan_of_a_million_units_takes_seconds_and_no_memory() -> None:
    start = time.perf_counter()
    assert count_of(1_000_000) == 1_000_000 + 1 + 1 + 5 + 1 + 3 + 1 + 1
    assert time.perf_counter() - start < 10
    tracemalloc.start()
    count_of(20_000)
    _, peak_nbytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak_nbytes < 2**17, "units are made when they are asked for"


def test_spec_refuses_stages_that_are_none() -> None:
    assert JobSpec(scene="tiny", settings={}, stages=("bake", "render")).last_stage == "render"
    for stages in ((), ("baking",)):
        with pytest.raises(JobSpecError, match="stages must be the first of bake, render, train, evaluate"):
            JobSpec(scene="tiny", settings={}, stages=stages)
