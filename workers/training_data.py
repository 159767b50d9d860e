"""What training reads: frames in memory, how they enter network space, and random crops of them."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from models.metrics import exposure_from_luminance, luminance
from models.transfer import Transfer
from storage.store import UnitRef
from workers.inputs import load_inputs
from workers.query import CHANNELS, NUM_CHANNELS
from workers.reconstruct import Encoding, pad_to_multiple
from workers.render import load_render
from workers.run_state import RunState
from workers.settings import TrainSettings


@dataclass
class Dataset:
    """Frames in memory.

    Attributes:
        features: float32 [frames, height, width, NUM_CHANNELS].
        target: linear radiance, float32 [frames, height, width, 3].
    """

    features: Tensor
    target: Tensor

    def __len__(self) -> int:
        return len(self.features)


def load_dataset(run: RunState, inputs: list[UnitRef], renders: list[UnitRef]) -> Dataset:
    """Reads input and target frames."""
    layer = "denoised" if run.settings.frames.denoise_train else "radiance"
    features, targets = [], []
    for input_ref, render_ref in zip(inputs, renders, strict=True):
        layers = load_inputs(run, input_ref)
        height, width = layers["ir"].shape[:2]
        frame = np.zeros((height, width, NUM_CHANNELS), np.float32)
        for name, (a, b) in CHANNELS.items():
            frame[..., a:b] = layers[name]
        features.append(frame)
        targets.append(load_render(run, render_ref)[layer])
    return Dataset(torch.from_numpy(np.stack(features)), torch.from_numpy(np.stack(targets)))


def fitted_encoding(train: Dataset, curve: str) -> Encoding:
    """Exposure and distance scale of the training frames, with the curve that `train.transfer` names."""
    targets = train.target.numpy()
    exposure = exposure_from_luminance([luminance(frame) for frame in targets])
    a = CHANNELS["distance"][0]
    farthest = float(train.features[..., a].max())
    name: Literal["log1p", "mu-law"] = "log1p" if curve == "log1p" else "mu-law"
    return Encoding(exposure, farthest if farthest > 0 else 1.0, Transfer(curve=name))


class CropSampler:
    """Random crops of frames that are kept in network space, NCHW in channels-last memory.

    Args:
        data: the frames.
        encoding: how they enter network space.
        settings: crop size and crops a step.
        multiple: edges of what the network takes are multiples of this many pixels.
        seed: of the crops.

    Attributes:
        rng: where the next crops come from; its state is part of a checkpoint.
        crop_px: edge of a crop.
    """

    def __init__(self, data: Dataset, encoding: Encoding, settings: TrainSettings, multiple: int, seed: int) -> None:
        self._batch_size = settings.batch
        self.rng = np.random.default_rng(seed)
        ir, gbuffer = encoding.inputs(data.features)
        target = encoding.transfer.forward(data.target * encoding.exposure).permute(0, 3, 1, 2)
        # Frames smaller than the network's multiple are padded, as at inference; larger ones are cropped to it.
        if min(target.shape[-2:]) < multiple:
            ir, gbuffer, target = (pad_to_multiple(x, multiple) for x in (ir, gbuffer, target))
        self._ir, self._gbuffer, self._target = ir, gbuffer, target
        smallest = min(target.shape[-2:])
        self.crop_px = max(multiple, min(settings.crop, smallest) // multiple * multiple)

    @property
    def steps_per_epoch(self) -> int:
        """Steps whose crops cover every training pixel once."""
        num_frames, _, height, width = self._target.shape
        crops = max(1, round(num_frames * height * width / self.crop_px**2))
        return max(1, -(-crops // self._batch_size))

    def batch(self, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
        """IR, G-buffers and targets of the next step, each [batch, channels, crop_px, crop_px]."""
        size = self.crop_px
        num_frames, _, height, width = self._target.shape
        parts: list[list[Tensor]] = [[], [], []]
        for _ in range(self._batch_size):
            frame = int(self.rng.integers(num_frames))
            y = int(self.rng.integers(height - size + 1)) if height >= size else 0
            x = int(self.rng.integers(width - size + 1)) if width >= size else 0
            for part, source in zip(parts, (self._ir, self._gbuffer, self._target), strict=True):
                part.append(source[frame, :, y : y + size, x : x + size])
        stacked = [torch.stack(part).to(device, memory_format=torch.channels_last) for part in parts]
        return stacked[0], stacked[1], stacked[2]
