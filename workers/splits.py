"""Which frames train, which validate, which test: by camera path, or by scene. Disjoint, and the same every time."""

from collections.abc import Collection
from typing import Literal

from storage.keys import seed_from_key
from workers.batch_matrix import BatchError

SplitBy = Literal["path", "scene"]
SPLIT_OF_PART = {"train": "train", "validation": "valid", "test": "test"}
HELD_OUT_SHARE = 0.1  # of the scenes, for each of validation and test; at least one
MIN_SCENES = 3


def split_of_part(part: str) -> str:
    """By camera path: path A's training poses train, its others validate, path B (another curve) tests."""
    return SPLIT_OF_PART[part]


def split_of_scenes(bases: Collection[str]) -> dict[str, str]:
    """By scene: every variant and preset of a scene falls into the same split.

    Scenes are ranked by a hash of their name, the first tenth (at least one) tests, the next validates.

    Raises:
        BatchError: fewer than three scenes.
    """
    ranked = sorted(set(bases), key=lambda base: (seed_from_key(base, "split"), base))
    if len(ranked) < MIN_SCENES:
        raise BatchError(
            f"a split by scene must have at least {MIN_SCENES} scenes, got {len(ranked)}; split by path instead"
        )
    num_held_out = max(1, round(HELD_OUT_SHARE * len(ranked)))
    splits = ["test"] * num_held_out + ["valid"] * num_held_out
    splits += ["train"] * (len(ranked) - len(splits))
    return dict(zip(ranked, splits, strict=True))
