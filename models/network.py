"""The two-branch fusion network that turns imperfect radiance (IR) and G-buffers into a frame.

After "Imperfect caches" section 4.4, figures 4 and 5: one encoder for the IR map, one for the G-buffers,
three scales joined by stride-2 convolutions, a fusion block at every scale and skip connections into the
decoder. The paper's text gives neither widths nor block counts; those here are ours, as are two options that
`NetworkConfig.paper_exact` turns off: work on blocks of k x k pixels (`unshuffle`), and predict a correction
of the IR map instead of the frame (`residual`).

Everything is NCHW, written for `channels_last`, bfloat16 and `torch.compile`: static shapes, no normalisation
layer, no control flow on data. What it cannot do: squeeze-and-excitation pools over the whole image, so a
crop and its frame differ slightly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from models.blocks import CHANNEL_GRANULE, ConcatenateEncoder, Decoder, FusionEncoder
from models.errors import ConfigError, ShapeError

NUM_SCALES = 3
RADIANCE_CHANNELS = 3


@dataclass(frozen=True, kw_only=True)
class NetworkConfig:
    """Shape of a `FusionNet`. `NetworkConfig(**dataclasses.asdict(config))` rebuilds it, through JSON too.

    Attributes:
        ir_channels: Channels of the IR input, >= 3; the first three are the imperfect radiance in transfer
            space.
        gbuffer_channels: Channels of the G-buffer input, >= 1 (the paper: normal 3, albedo 3, depth 1).
        widths: Feature channels of one branch at the three scales, finest first; multiples of 16.
        fusion: "fuse" (the paper's two branches) or "concatenate" (the paper's ablation: one encoder on both
            inputs together).
        unshuffle: Edge in pixels of the blocks folded into channels before the first convolution: 1, 2 or 4.
        residual: Add the imperfect radiance to the output, so that an untrained network returns it unchanged.
        negative_slope: Slope of the activation below 0, in [0, 1); 0 is ReLU, whose units can die: on noisy
            targets those of the last layer did before its zero-initialised head had learned to use them.

    Raises:
        ConfigError: A value outside the above.
    """

    ir_channels: int = 3
    gbuffer_channels: int = 7
    widths: tuple[int, int, int] = (32, 48, 80)
    fusion: Literal["fuse", "concatenate"] = "fuse"
    unshuffle: int = 2
    residual: bool = True
    negative_slope: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "widths", tuple(self.widths))
        if self.ir_channels < RADIANCE_CHANNELS:
            raise ConfigError(f"ir_channels must be at least {RADIANCE_CHANNELS}, got {self.ir_channels}")
        if self.gbuffer_channels < 1:
            raise ConfigError(f"gbuffer_channels must be at least 1, got {self.gbuffer_channels}")
        if len(self.widths) != NUM_SCALES or any(w < 1 or w % CHANNEL_GRANULE for w in self.widths):
            raise ConfigError(f"widths must be {NUM_SCALES} positive multiples of {CHANNEL_GRANULE}, got {self.widths}")
        if self.fusion not in ("fuse", "concatenate"):
            raise ConfigError(f'fusion must be "fuse" or "concatenate", got {self.fusion!r}')
        if self.unshuffle not in (1, 2, 4):
            raise ConfigError(f"unshuffle must be 1, 2 or 4, got {self.unshuffle}")
        if not 0.0 <= self.negative_slope < 1.0:
            raise ConfigError(f"negative_slope must be in [0, 1), got {self.negative_slope}")

    @classmethod
    def paper_exact(cls, *, gbuffer_channels: int = 7) -> NetworkConfig:
        """The paper's network as far as its text tells: full resolution, the frame itself as output."""
        return cls(gbuffer_channels=gbuffer_channels, unshuffle=1, residual=False)

    @property
    def size_multiple(self) -> int:
        """Height and width of the input must be multiples of this many pixels."""
        return self.unshuffle * 2 ** (NUM_SCALES - 1)


class FusionNet(nn.Module):
    """IR map and G-buffers to a frame, all in transfer space (`models.transfer.Transfer`).

    Weights may be bfloat16 while inputs stay float32: inputs are converted on the way in, and the residual is
    added in the input's own precision, because bfloat16's 8 bits would band the radiance itself.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        block = config.unshuffle**2
        encoder = FusionEncoder if config.fusion == "fuse" else ConcatenateEncoder
        slope = config.negative_slope
        self.encoder = encoder(config.ir_channels * block, config.gbuffer_channels * block, config.widths, slope)
        self.decoder = Decoder(self.encoder.skip_channels, config.widths, slope)
        self.head = nn.Conv2d(config.widths[0], RADIANCE_CHANNELS * block, 3, padding=1)
        if config.residual:
            for parameter in self.head.parameters():
                nn.init.zeros_(parameter)

    def forward(
        self,
        ir: Float[Tensor, "batch ir_channels height width"],
        gbuffer: Float[Tensor, "batch gbuffer_channels height width"],
    ) -> Float[Tensor, "batch 3 height width"]:
        """Reconstructs a batch of frames.

        Args:
            ir: B,ir_channels,H,W; the first three channels are imperfect radiance in transfer space.
            gbuffer: B,gbuffer_channels,H,W; about unit range.

        Returns:
            B,3,H,W radiance in transfer space, in the dtype of `ir`. May lie slightly below 0; the inverse
            transfer clamps it.

        Raises:
            ShapeError: Channels other than configured, or H, W no multiples of `config.size_multiple`.
        """
        self._check(ir, gbuffer)
        dtype, block = self.head.weight.dtype, self.config.unshuffle
        skips = self.encoder(F.pixel_unshuffle(ir.to(dtype), block), F.pixel_unshuffle(gbuffer.to(dtype), block))
        output = F.pixel_shuffle(self.head(self.decoder(skips)), block).to(ir.dtype)
        return ir[:, :RADIANCE_CHANNELS] + output if self.config.residual else output

    def _check(self, ir: Tensor, gbuffer: Tensor) -> None:
        config, multiple = self.config, self.config.size_multiple
        for name, tensor, channels in (
            ("ir", ir, config.ir_channels),
            ("gbuffer", gbuffer, config.gbuffer_channels),
        ):
            if tensor.ndim != 4 or tensor.shape[1] != channels:
                raise ShapeError(f"{name} must be of shape B,{channels},H,W, got {tuple(tensor.shape)}")
        height, width = ir.shape[2:]
        if height % multiple or width % multiple:
            raise ShapeError(
                f"height and width must be multiples of {multiple}, got {height} x {width}; pad the inputs"
            )
        if gbuffer.shape[0] != ir.shape[0] or gbuffer.shape[2:] != ir.shape[2:]:
            raise ShapeError(f"gbuffer must match ir {tuple(ir.shape)} but for channels, got {tuple(gbuffer.shape)}")


def num_parameters(network: nn.Module) -> int:
    """Number of trainable scalars."""
    return sum(p.numel() for p in network.parameters() if p.requires_grad)


def network_flops(config: NetworkConfig, height: int, width: int) -> int:
    """Floating-point operations (a multiply-add is 2) of all convolutions and linear layers for one frame.

    Counted on the meta device: nothing is computed or allocated. `height`, `width` in pixels, multiples of
    `config.size_multiple`.
    """
    with torch.device("meta"), torch.no_grad(), FlopCounterMode(display=False) as counter:
        network = FusionNet(config)
        network(
            torch.empty(1, config.ir_channels, height, width),
            torch.empty(1, config.gbuffer_channels, height, width),
        )
    return counter.get_total_flops()
