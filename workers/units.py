"""A run as units of work with dependencies: what an engine sends to its workers. Data only, nothing heavy here.

A run is planned in three steps, each from what the one before has put into the store:

    census      -> elements and one render unit a frame     (needs the scene: done on a worker)
    elements    -> which cache elements there are
    inventory   -> groups of bake units, inputs, training, evaluation

Blocks of like units stay ranges until a unit is asked for, so a plan of a million units costs as much as one of ten.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from workers.job_spec import STAGES

PATHS = ("train", "validation", "test")
LANES_PER_TASK = 1 << 23  # camera paths of one task: seconds of work, so that handing it out costs nothing beside it
MIN_TASKS = 16  # of a cache set, so that several workers share a small one


@dataclass(frozen=True, slots=True)
class Unit:
    """One unit of work.

    Attributes:
        stage: "census", "elements", "render", "inventory", "bake", "seal", "inputs", "train" or "evaluate".
        part: lobe of a bake or seal, camera path of a render or inputs, else "".
        first, count: bake units or frames that it covers.
        key: of the store's unit that it fills; "" where it fills none, or where `without` decides.
        without: frames that were set aside, as "train/3"; of train and evaluate only.
    """

    stage: str
    part: str = ""
    first: int = 0
    count: int = 1
    key: str = ""
    without: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The unit in a person's words, unique within a job."""
        if self.stage == "bake":
            return f"bake {self.part} {self.first}-{self.first + self.count - 1}"
        if self.stage in ("render", "inputs"):
            return f"{self.stage} {self.part} {self.first}"
        return f"{self.stage} {self.part}".strip()


@dataclass(frozen=True)
class Block:
    """Units of one stage and part: a lazy sequence.

    Attributes:
        stage, part: of every unit.
        total: bake units or frames in all.
        group: of them in one unit of work.
        keys: of the store's units: one for each, or a single one for all.
        needs: names of the blocks that must have ended before.
        by_frame: a unit that is set aside costs one frame, and what needs the block goes on without it.
    """

    stage: str
    part: str = ""
    total: int = 1
    group: int = 1
    keys: tuple[str, ...] = ("",)
    needs: tuple[str, ...] = ()
    by_frame: bool = False

    @property
    def name(self) -> str:
        return f"{self.stage} {self.part}".strip()

    def __len__(self) -> int:
        return -(-self.total // self.group)

    def __getitem__(self, index: int) -> Unit:
        if not 0 <= index < len(self):
            raise IndexError(f"unit must be in [0, {len(self)}), got {index}")
        first = index * self.group
        key = self.keys[0 if len(self.keys) == 1 else index]
        return Unit(self.stage, self.part, first, min(self.group, self.total - first), key)

    def pending(self, done: Collection[int]) -> Iterator[Unit]:
        """Units that hold a member which is not done, in order."""
        if not done:
            yield from (self[index] for index in range(len(self)))
            return
        for index in range(len(self)):
            first = index * self.group
            if any(member not in done for member in range(first, min(first + self.group, self.total))):
                yield self[index]


@dataclass(frozen=True)
class Census:
    """Keys of a run that the scene alone decides.

    Attributes:
        digest: of the scene.
        elements: key of the element set.
        renders: keys of the frames of each of `PATHS`.
    """

    digest: str
    elements: str
    renders: Mapping[str, tuple[str, ...]]

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> "Census":
        return cls(value["digest"], value["elements"], {p: tuple(keys) for p, keys in value["renders"].items()})


@dataclass(frozen=True)
class LobeInventory:
    """One cache set: its key, how many bake units it has, how many camera paths each of them costs, and the set in
    which its paths end, which must be whole before ("" for none)."""

    key: str
    num_units: int
    lanes_per_unit: int
    after: str = ""

    @property
    def group(self) -> int:
        """Bake units in one unit of work. A function of the set alone: two jobs that share it group it alike."""
        return max(1, min(LANES_PER_TASK // max(self.lanes_per_unit, 1), self.num_units // MIN_TASKS))


@dataclass(frozen=True)
class Inventory:
    """Keys of a run that its elements decide: cache sets by lobe, inputs by path."""

    lobes: Mapping[str, LobeInventory]
    inputs: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> "Inventory":
        lobes = {name: LobeInventory(**lobe) for name, lobe in value["lobes"].items()}
        return cls(lobes, {path: tuple(keys) for path, keys in value["inputs"].items()})


CENSUS = Block("census")
# What workers take up first where several blocks are ready: what most depends on, then what training needs.
PRIORITY = ("census", "elements", "inventory", "bake", "seal", "inputs", "render train", "render validation", "train",
            "render test", "evaluate")  # fmt: skip


def by_priority(block: Block) -> int:
    """Sort key of a block: its place in `PRIORITY`."""
    return PRIORITY.index(block.name if block.name in PRIORITY else block.stage)


def blocks_after_census(census: Census, last_stage: str) -> list[Block]:
    """Elements, the inventory, and the frames that later stages need."""
    blocks = [Block("elements", keys=(census.elements,), needs=(CENSUS.name,)), Block("inventory", needs=("elements",))]
    if _reaches(last_stage, "render"):
        for path, keys in census.renders.items():
            if keys:
                needs = (CENSUS.name,)
                blocks.append(Block("render", path, len(keys), keys=keys, needs=needs, by_frame=True))
    return blocks


def blocks_after_inventory(census: Census, inventory: Inventory, last_stage: str) -> list[Block]:
    """Bakes, and what is made of them."""
    blocks = []
    for lobe, found in inventory.lobes.items():
        key = (found.key,)
        needs = ("inventory", f"seal {found.after}") if found.after else ("inventory",)
        blocks.append(Block("bake", lobe, found.num_units, found.group, key, needs=needs))
        blocks.append(Block("seal", lobe, keys=key, needs=(f"bake {lobe}",)))
    if not _reaches(last_stage, "train"):
        return blocks
    sealed = ("inventory", *(f"seal {lobe}" for lobe in inventory.lobes))
    frames = {path: keys for path, keys in inventory.inputs.items() if keys}
    for path, keys in frames.items():
        blocks.append(Block("inputs", path, len(keys), keys=keys, needs=sealed, by_frame=True))
    used = tuple(f"{stage} {path}" for path in frames for stage in ("inputs", "render"))
    blocks.append(Block("train", needs=used))
    if _reaches(last_stage, "evaluate"):
        blocks.append(Block("evaluate", needs=("train", "render test")))
    return blocks


def _reaches(last_stage: str, stage: str) -> bool:
    return STAGES.index(last_stage) >= STAGES.index(stage)
