"""Inference: queried features to a frame, with precision and compilation chosen by measurement."""

import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from models.metrics import psnr, tone_map
from models.network import FusionNet, NetworkConfig
from models.transfer import Transfer
from workers.backend import pool_at_rest
from workers.query import CHANNELS
from workers.timing import bf16_is_fast

# bf16 is used only where its frame is this close to fp32's: far below what any reference can resolve.
BF16_GATE_DB = 50.0
# Rounds in which candidates take turns; more of them while they take less than this.
MIN_PROBE_ROUNDS, MAX_PROBE_ROUNDS, PROBE_SECONDS = 3, 15, 1.5
MAX_SIZES = 16
"""Frame sizes whose choice is remembered; the one that was asked for longest ago is measured again."""
MAX_COMPILED = 8
"""Frame sizes that are compiled at most: torch keeps each of a module's programs until the process ends."""


@dataclass(frozen=True)
class Encoding:
    """How features enter and leave network space; saved with every network.

    Attributes:
        exposure: e; networks work on e * L.
        distance_scale: d_max, scene units: distance enters as d / d_max.
        transfer: curve of radiance.
    """

    exposure: float
    distance_scale: float
    transfer: Transfer

    def inputs(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """[batch, height, width, channels] features to (IR, G-buffer), channels-first views of channels-last memory."""
        a, b = CHANNELS["ir"]
        ir = self.transfer.forward(features[..., a:b] * self.exposure)
        start, end = CHANNELS["normal"][0], CHANNELS["distance"][1]
        gbuffer = features[..., start:end].clone()
        gbuffer[..., -1].div_(self.distance_scale).clamp_(0.0, 1.0)
        return ir.permute(0, 3, 1, 2), gbuffer.permute(0, 3, 1, 2)

    def radiance(self, output: Tensor) -> Tensor:
        """Network output [batch, 3, height, width] to linear scene radiance, the same shape."""
        return self.transfer.inverse(output.float()) / self.exposure

    def to_json(self) -> dict[str, Any]:
        return {"exposure": self.exposure, "distance_scale": self.distance_scale, "curve": self.transfer.curve,
                "mu": self.transfer.mu}  # fmt: skip

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> "Encoding":
        return cls(value["exposure"], value["distance_scale"], Transfer(curve=value["curve"], mu=value["mu"]))


GBUFFER_CHANNELS = CHANNELS["distance"][1] - CHANNELS["normal"][0]


def pad_to_multiple(tensor: Tensor, multiple: int) -> Tensor:
    """Repeats the last row and column until height and width are multiples; NCHW."""
    height, width = tensor.shape[-2:]
    bottom, right = -height % multiple, -width % multiple
    return F.pad(tensor, (0, right, 0, bottom), mode="replicate") if bottom or right else tensor


class FrameModule(nn.Module):
    """From queried features to radiance in one module, so that a compiler fuses the transfer functions too."""

    def __init__(self, network: FusionNet, encoding: Encoding) -> None:
        super().__init__()
        self.network, self.encoding = network, encoding

    def forward(self, features: Tensor) -> Tensor:
        """[height, width, NUM_CHANNELS] to linear radiance [height, width, 3], both float32."""
        height, width = features.shape[:2]
        multiple = self.network.config.size_multiple
        inputs = [pad_to_multiple(x, multiple) for x in self.encoding.inputs(features[None])]
        output = self.network(*inputs)[..., :height, :width]
        return self.encoding.radiance(output)[0].permute(1, 2, 0).contiguous()


class Reconstructor:
    """A trained network ready to turn features into frames.

    Args:
        network: the network, fp32.
        encoding: its transfer functions.
        precision: "fp32", "bf16" or "auto" (bf16 where the device computes in it, and it passes `BF16_GATE_DB` and is
            faster).
        compile: try `torch.compile` and keep it where it is faster; costs tens of seconds a size. Sizes beyond the
            first `MAX_COMPILED` run without.

    Attributes:
        hands_on: whether the network adds nothing to the imperfect radiance; it is then not computed.
    """

    def __init__(
        self, network: FusionNet, encoding: Encoding, *, precision: str = "auto", compile: bool = False
    ) -> None:
        self.encoding = encoding
        self.device = next(network.parameters()).device
        self.config: NetworkConfig = network.config
        self._fp32 = FrameModule(channels_last(network.eval()), encoding)
        self.hands_on = _hands_on(network)
        self._precision, self._compile = precision, compile
        self._chosen: OrderedDict[tuple[int, int], tuple[str, Any]] = OrderedDict()  # the latest size last
        self._num_compiled = 0

    @property
    def choices(self) -> dict[str, str]:
        """What was chosen for the sizes that are remembered: {"640x360": "bf16 compiled"}."""
        return {f"{width}x{height}": name for (height, width), (name, _) in self._chosen.items()}

    def __call__(self, features: np.ndarray, before: Callable[[], Any] | None = None) -> np.ndarray:
        """float32 [height, width, NUM_CHANNELS] to linear radiance, float32 [height, width, 3].

        Args:
            features: as the query gives them.
            before: what runs before every frame, such as the query: candidates of a new size are measured after it.
        """
        size: tuple[int, int] = features.shape[0], features.shape[1]
        with torch.inference_mode():
            tensor = torch.from_numpy(features).to(self.device, non_blocking=True)
            if size not in self._chosen:
                self._chosen[size] = ("fp32", None) if self.hands_on else self._choose(tensor, before)
            self._chosen.move_to_end(size)
            if len(self._chosen) > MAX_SIZES:
                self._chosen.popitem(last=False)
            _, module = self._chosen[size]
            if module is None:
                return np.ascontiguousarray(features[..., slice(*CHANNELS["ir"])])
            with pool_at_rest():
                return module(tensor).cpu().numpy()

    def _choose(self, features: Tensor, before: Callable[[], Any] | None) -> tuple[str, Any]:
        """Measures the candidates on real input of a size; returns the best one's name and itself."""
        candidates: dict[str, Any] = {"fp32": self._fp32}
        tries_bf16 = self._precision == "bf16" or (self._precision == "auto" and bf16_is_fast(self.device))
        if tries_bf16 and self._passes_gate(self._bf16, features):
            candidates["bf16"] = self._bf16
        if self._precision == "bf16" and "bf16" in candidates:
            del candidates["fp32"]
        if len(candidates) == 1 and not self._compile:  # nothing to measure
            return next(iter(candidates.items()))
        best = _fastest(candidates, features, before)
        if self._compile and self._num_compiled < MAX_COMPILED:
            self._num_compiled += 1
            compiled = _try_compile(candidates[best], features)
            if compiled is not None:
                candidates = {best: candidates[best], f"{best} compiled": compiled}
                best = _fastest(candidates, features, before)
        return best, candidates[best]

    @cached_property
    def _bf16(self) -> FrameModule:
        """One copy of the network for all sizes."""
        network = FusionNet(self.config).to(self.device)
        network.load_state_dict(self._fp32.network.state_dict())
        return FrameModule(channels_last(network.eval().to(torch.bfloat16)), self.encoding)

    def _passes_gate(self, bf16: FrameModule, features: Tensor) -> bool:
        frames = [module(features).cpu().numpy() for module in (self._fp32, bf16)]
        if not all(np.isfinite(frame).all() for frame in frames):
            return False
        shown = [tone_map(frame, self.encoding.exposure) for frame in frames]
        return psnr(shown[1], shown[0]) >= BF16_GATE_DB


def _hands_on(network: FusionNet) -> bool:
    """Whether a network returns the imperfect radiance as it is: one whose plan said that none is needed."""
    return network.config.residual and not any(bool(parameter.any()) for parameter in network.head.parameters())


def channels_last(network: FusionNet) -> FusionNet:
    """Lays convolution weights out for channels-last input, in place."""
    for parameter in network.parameters():
        if parameter.dim() == 4:
            parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
    return network


def _fastest(candidates: dict[str, Any], features: Tensor, before: Callable[[], Any] | None) -> str:
    """Name of the candidate with the shortest run, each right after `before`.

    Back to back, eager and compiled bfloat16 took the same 8 ms of a 256x256 frame; after its query, 10 and 23. They
    take turns, so that what else runs meanwhile hits all.
    """
    for module in candidates.values():
        module(features)
    shortest, start = dict.fromkeys(candidates, float("inf")), time.perf_counter()
    for index in range(MAX_PROBE_ROUNDS):
        if index >= MIN_PROBE_ROUNDS and time.perf_counter() - start > PROBE_SECONDS:
            break
        for name, module in candidates.items():
            if before is not None:
                before()
            with pool_at_rest():
                shortest[name] = min(shortest[name], _seconds(module, features))
    return min(shortest, key=lambda name: shortest[name])


def _seconds(module: Any, features: Tensor) -> float:
    start = time.perf_counter()
    module(features)
    if features.is_cuda:
        torch.cuda.synchronize()
    return time.perf_counter() - start


def _try_compile(module: Any, features: Tensor) -> Any:
    """The compiled module, or None where this machine cannot compile (no C++ compiler, say)."""
    try:
        compiled = torch.compile(module, dynamic=False)
        compiled(features)
    except Exception:  # torch raises many kinds; eager is always there
        return None
    return compiled
