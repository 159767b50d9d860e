"""A dataset folder as a `torch.utils.data.Dataset`: (noisy frame, reference) pairs, read when they are asked for.

    dataset = FrameDataset("dataset", "train", crop=128)
    for epoch in range(100):
        dataset.set_epoch(epoch)                                  # other crops
        for batch in DataLoader(dataset, batch_size=8, num_workers=4, persistent_workers=True, shuffle=True):
            loss = ...(batch["input"], batch["albedo"], batch["normal"], batch["target"])

Nothing but the manifest is held in memory, and nothing random but (seed, epoch, index) decides a crop, so any number of
loader processes gives the same samples.
"""

import os
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from storage.dataset_layout import SPLITS
from storage.datasets import open_dataset, read_feature
from workers.errors import WorkerError


class FrameDatasetError(WorkerError, ValueError):
    """A dataset has no such split, or its frames do not fit what is asked of them."""


@dataclass(frozen=True)
class _Pair:
    """One sample: the noisy image (the reference's own where there is none) and its frame."""

    frame: dict[str, Any]
    noisy: dict[str, Any] | None
    reference: dict[str, Any]


class FrameDataset(Dataset[dict[str, Any]]):
    """Pairs of a noisy frame and its reference, of one split.

    A sample is a dict of

        input     float32 [3, height, width], linear scene radiance, noisy; left out where there are no noisy frames
        target    float32 [3, height, width], linear scene radiance of the reference
        albedo    float32 [3, height, width], 0 to 1, of the input (of the reference where there is none)
        normal    float32 [3, height, width], world space, -1 to 1, likewise
        exposure  float32 [], the scene's: 1 / exposure is about what a screen shows as white
        name      the input's name in the dataset

    Args:
        folder: the dataset.
        split: "train", "valid" or "test".
        crop: edge of random square crops in pixels; None gives whole frames.
        input_spp: keep only noisy frames of these samples a pixel; None keeps all.
        seed: chooses the crops.

    Raises:
        StorageError: there is no dataset in the folder.
        FrameDatasetError: no such split, no such samples, or a frame smaller than the crop.
    """

    def __init__(
        self, folder: str | os.PathLike[str], split: Literal["train", "valid", "test"] = "train", *,
        crop: int | None = None, input_spp: tuple[int, ...] | None = None, seed: int = 0,
    ) -> None:  # fmt: skip
        if split not in SPLITS:
            raise FrameDatasetError(f"split must be one of {', '.join(SPLITS)}, got {split!r}")
        self.files, manifest = open_dataset(folder)
        self.crop, self.seed = crop, seed
        self._pairs = [pair for frame in manifest["frames"] if frame["split"] == split
                       for pair in _pairs_of(frame, input_spp)]  # fmt: skip
        if input_spp is not None and not self._pairs:
            raise FrameDatasetError(f"input_spp must be in the dataset's {split} split, got {input_spp}")
        self._check_crop()
        # Loader processes that outlive an epoch see a new one only in shared memory.
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()

    def __len__(self) -> int:
        return len(self._pairs)

    def set_epoch(self, epoch: int) -> None:
        """Chooses other crops; reaches running loader processes too."""
        self._epoch.fill_(epoch)

    def __getitem__(self, index: int) -> dict[str, Any]:
        """One sample.

        Raises:
            IndexError: there are fewer.
            DatasetError: a file's bytes are not what the manifest says.
        """
        if index < 0:
            index += len(self)
        if not 0 <= index < len(self):
            raise IndexError(f"sample must be one of {len(self)}, got {index}")
        pair = self._pairs[index]
        image = pair.noisy or pair.reference
        window = self._window(pair, index)
        sample: dict[str, Any] = {
            "target": self._read(pair.reference, "hdr", window),
            "albedo": self._read(image, "alb", window),
            "normal": self._read(image, "nrm", window),
            "exposure": torch.tensor(pair.frame["exposure"], dtype=torch.float32),
            "name": image["name"],
        }
        if pair.noisy is not None:
            sample["input"] = self._read(pair.noisy, "hdr", window)
        return sample

    def provenance(self, index: int) -> dict[str, Any]:
        """What the manifest says of a sample's frame: scene, variation, camera, units, seeds, health."""
        return self._pairs[index].frame

    def _window(self, pair: _Pair, index: int) -> tuple[slice, slice]:
        if self.crop is None:
            return slice(None), slice(None)
        rng = np.random.default_rng([self.seed, int(self._epoch), index])
        width, height = pair.frame["camera"]["width"], pair.frame["camera"]["height"]
        y, x = int(rng.integers(height - self.crop + 1)), int(rng.integers(width - self.crop + 1))
        return slice(y, y + self.crop), slice(x, x + self.crop)

    def _read(self, image: dict[str, Any], feature: str, window: tuple[slice, slice]) -> Tensor:
        pixels = read_feature(self.files, image["files"][feature])[window]
        return torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1)))

    def _check_crop(self) -> None:
        if self.crop is None:
            return
        edges = [min(pair.frame["camera"]["width"], pair.frame["camera"]["height"]) for pair in self._pairs]
        if self.crop < 1 or self.crop > min(edges, default=self.crop):
            raise FrameDatasetError(f"crop must be 1 to {min(edges, default=0)} pixels, got {self.crop}")


def _pairs_of(frame: dict[str, Any], input_spp: tuple[int, ...] | None) -> list[_Pair]:
    reference = next(image for image in frame["images"] if image["role"] == "reference")
    noisy = [image for image in frame["images"] if image["role"] == "input"]
    kept = [image for image in noisy if input_spp is None or image["spp"] in input_spp]
    if not noisy and input_spp is None:
        return [_Pair(frame, None, reference)]
    return [_Pair(frame, image, reference) for image in kept]
