"""The trainer: one network, its optimizer, schedule and validation; resumes exactly from its checkpoint."""

import dataclasses
import os
import time
from collections import deque
from typing import Any

import numpy as np
import torch
from torch import Tensor

from models.losses import LossConfig, ReconstructionLoss
from models.metrics import psnr, tone_map
from models.network import FusionNet, NetworkConfig
from models.perceptual import MIN_SIZE_PX, StLpips
from storage.perceptual_weights import find_stlpips
from storage.store import UnitRef
from workers.checkpoints import load_checkpoint, save_checkpoint
from workers.errors import StoppedError, WorkerError
from workers.reconstruct import GBUFFER_CHANNELS, FrameModule, channels_last
from workers.run_state import RunState
from workers.schedule import learning_rate
from workers.timing import bf16_is_fast
from workers.training_data import CropSampler, Dataset, fitted_encoding

CHECKPOINT_SECONDS = float(os.environ.get("LIGHTWELL_CHECKPOINT_SECONDS", "60"))
VALIDATIONS = 20
PROBE_STEPS = 8
CLIP_STEPS = 500
"""Steps whose gradient norms tell what is usual."""
REPLAN_UNTIL = 0.5
"""Share of the steps up to which their number follows the pace: the schedule's end stays what it was meant to be."""


class Trainer:
    """Model, optimizer, schedule, random state and data cursor of one training run."""

    def __init__(self, run: RunState, ref: UnitRef, train: Dataset, validation: Dataset | None) -> None:
        self.run, self.ref, self.settings = run, ref, run.settings.train
        self.validation_set = validation
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.encoding = fitted_encoding(train, self.settings.transfer)
        seed = run.seed(ref)
        torch.manual_seed(seed)
        self.config = NetworkConfig(
            ir_channels=3, gbuffer_channels=GBUFFER_CHANNELS, widths=tuple(self.settings.widths),  # type: ignore[arg-type]  # three, by the settings' own check
            fusion=self.settings.fusion, unshuffle=self.settings.unshuffle, residual=self.settings.residual,
            negative_slope=self.settings.negative_slope,
        )  # fmt: skip
        self.network = channels_last(FusionNet(self.config).to(self.device))
        self.optimizer = self._optimizer()
        self.crops = CropSampler(train, self.encoding, self.settings, self.config.size_multiple, seed)
        self.loss, self.plain_loss = self._losses()
        self.step, self.num_steps, self.skipped = 0, 0, 0
        self.spent_s, self.next_validation = 0.0, 0
        self.norms: deque[float] = deque(maxlen=CLIP_STEPS)
        self.autocast = False
        self.curve: list[dict[str, float]] = []
        self._best: dict[str, Tensor] | None = None
        self._resume()

    # ------------------------------------------------ set-up ------------------------------------------------

    def _losses(self) -> tuple[ReconstructionLoss, ReconstructionLoss]:
        """The loss with its perceptual term and the one of the steps between."""
        settings = self.settings
        perceptual = None
        if 0 < self.crops.crop_px < MIN_SIZE_PX:
            self.run.progress.message(f"crops are below ST-LPIPS's {MIN_SIZE_PX} pixels: training without it")
        elif settings.perceptual_weight > 0:
            weights = find_stlpips()
            if weights is None:
                self.run.progress.message(
                    "ST-LPIPS weights are not installed: training with L1 + multi-scale gradient instead "
                    "(pip install --no-deps stlpips_pytorch)"
                )
            else:
                perceptual = StLpips(weights["alex"] if "alex" in weights else weights["vgg"]).to(self.device)
        gradient = settings.gradient_weight if settings.gradient_weight > 0 else None
        every = settings.perceptual_every if settings.l1_weight > 0 else 1
        transfer = self.encoding.transfer
        config = LossConfig(l1=settings.l1_weight, perceptual=settings.perceptual_weight * every, gradient=gradient)
        full = ReconstructionLoss(config, transfer=transfer, perceptual=perceptual)
        if perceptual is None or settings.l1_weight == 0:
            return full, full
        plain = LossConfig(l1=settings.l1_weight, perceptual=0.0, gradient=gradient)
        return full, ReconstructionLoss(plain, transfer=transfer)

    def _resume(self) -> None:
        state = load_checkpoint(self.run, self.ref)
        if state is None or "norms" not in state:  # none, or of a version that did not keep them
            return
        self.network.load_state_dict(state["network"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.crops.rng.bit_generator.state = state["rng"]
        torch.set_rng_state(state["torch_rng"])
        self.step, self.num_steps, self.skipped = state["step"], state["num_steps"], state["skipped"]
        self.spent_s, self.next_validation = state["spent_s"], state["next_validation"]
        self.autocast = state["autocast"]
        self.norms.extend(state["norms"])
        self.curve, self._best = state["curve"], state["best"]

    # ----------------------------------------------- training ----------------------------------------------

    def fit(self) -> None:
        """Runs the remaining steps."""
        self.num_steps = self.num_steps or self._planned_steps()
        saved = time.perf_counter()
        if self.step == 0:
            self._validate()
        with self.run.progress.track("train", self.num_steps) as advance:
            shown, total = float(self.step), float(self.num_steps)
            advance(shown)
            while self.step < self.num_steps:
                share = (total - shown) / (self.num_steps - self.step)  # their number may change on the way
                terms = self._timed_step()
                last = self.curve[-1].get("psnr")
                try:
                    advance(share, f"loss {terms['total']:.4f}" + (f", validation {last:.2f} dB" if last else ""))
                except StoppedError:
                    self.save_checkpoint()
                    raise
                shown += share
                if time.perf_counter() - saved > CHECKPOINT_SECONDS:
                    self.save_checkpoint()
                    saved = time.perf_counter()

    def _timed_step(self) -> dict[str, float]:
        """A step, and the validation that is due after it."""
        start = time.perf_counter()
        terms = self.train_step()
        is_due = self.step >= self.next_validation or self.step == self.num_steps
        if is_due:
            self._validate()
        self.spent_s += time.perf_counter() - start
        if is_due:
            self._replan()
        return terms

    def _planned_steps(self) -> int:
        """Chooses the precision and the number of steps: all epochs, fewer where the time budget ends first.

        Both are measured over a few steps, then undone and fixed, so that a resumed run keeps them.
        """
        settings = self.settings
        full = settings.epochs * self.crops.steps_per_epoch
        if full == 0 or (settings.seconds <= 0 and settings.precision == "fp32"):
            return full
        seconds = {False: self._probe(full, False)}
        if settings.precision == "bf16" or (settings.precision == "auto" and bf16_is_fast(self.device)):
            seconds[True] = self._probe(full, True)
        self.autocast = settings.precision == "bf16" or min(seconds, key=lambda key: seconds[key])
        if settings.seconds <= 0:
            return full
        return int(np.clip(settings.seconds / seconds[self.autocast], 1, full))

    def _replan(self) -> None:
        """Fits the number of steps to the pace so far: a few probed steps may have met a busy or an idle moment."""
        budget_s, full = self.settings.seconds, self.settings.epochs * self.crops.steps_per_epoch
        if budget_s > 0 and self.step <= REPLAN_UNTIL * self.num_steps:
            self.num_steps = int(np.clip(budget_s * self.step / self.spent_s, self.step, full))

    def _probe(self, num_steps: int, autocast: bool) -> float:
        """Mean seconds of a step; leaves weights, optimizer, random state and cursor as they were."""
        state = {name: value.clone() for name, value in self.network.state_dict().items()}
        rng, torch_rng, skipped = self.crops.rng.bit_generator.state, torch.get_rng_state(), self.skipped
        self.num_steps, self.autocast = num_steps, autocast
        self.train_step()
        start = time.perf_counter()
        for _ in range(PROBE_STEPS):
            self.train_step()
        seconds = (time.perf_counter() - start) / PROBE_STEPS
        self.network.load_state_dict(state)
        self.optimizer = self._optimizer()
        self.crops.rng.bit_generator.state, self.step, self.num_steps, self.skipped = rng, 0, 0, skipped
        self.norms.clear()
        torch.set_rng_state(torch_rng)
        return seconds

    def _optimizer(self) -> torch.optim.Optimizer:
        return torch.optim.Adam(self.network.parameters(), lr=self.settings.learning_rate, betas=(0.9, 0.999))

    def train_step(self) -> dict[str, float]:
        """One optimizer step on random crops; returns the loss terms."""
        ir, gbuffer, target = self.crops.batch(self.device)
        lr = learning_rate(self.settings, self.step, self.num_steps, self.crops.steps_per_epoch)
        for group in self.optimizer.param_groups:
            group["lr"] = lr
        self.optimizer.zero_grad(set_to_none=True)
        with torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=self.autocast):
            output = self.network(ir, gbuffer)
        terms = self._loss_terms(output.float(), target)
        terms["total"].backward()
        gradients = [parameter.grad for parameter in self.network.parameters() if parameter.grad is not None]
        norm = torch.nn.utils.get_total_norm(gradients)
        if torch.isfinite(norm):
            torch.nn.utils.clip_grads_with_norm_(self.network.parameters(), self._clip_at(float(norm)), norm)
            self.optimizer.step()
        else:
            self.skipped += 1
            if self.skipped > 0.05 * max(self.num_steps, 100):
                raise WorkerError(
                    f"training must have finite gradients, got {self.skipped} steps that have not; "
                    "lower train.learning_rate"
                )
        self.step += 1
        return {name: float(value.detach()) for name, value in terms.items()}

    def _clip_at(self, norm: float) -> float:
        """Largest norm of a gradient that is applied: `clip_quantile` of those of the last steps.

        AutoClip (Seetharaman et al., MLSP 2020): what is much differs by scene, and the largest norms are ten times
        the median. Against `clip_norm` alone it gained 1.0 dB in the same 35 s on modern-hall.
        """
        self.norms.append(norm)
        return min(self.settings.clip_norm, float(np.quantile(self.norms, self.settings.clip_quantile)))

    def _loss_terms(self, output: Tensor, target: Tensor) -> dict[str, Tensor]:
        """The loss; its perceptual term costs several network passes, so it is taken on every
        `perceptual_every`-th step with that much more weight."""
        every = self.settings.perceptual_every
        takes_perceptual = self.step % every == 0 or self.settings.l1_weight == 0
        with torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=self.autocast):
            return (self.loss if takes_perceptual else self.plain_loss)(output, target)

    # ---------------------------------------------- validation ---------------------------------------------

    def _validate(self) -> None:
        """Adds a point to the validation curve and keeps the best weights."""
        point: dict[str, float] = {"step": float(self.step)}
        data = self.validation_set
        if data is not None:
            point["psnr"] = float(np.mean([self._score(data, i) for i in range(len(data))]))
            best = max((p["psnr"] for p in self.curve if "psnr" in p), default=-np.inf)
            if point["psnr"] >= best:
                self._best = {k: v.detach().clone() for k, v in self.network.state_dict().items()}
        self.curve.append(point)
        self.next_validation = self.step + max(1, self.num_steps // VALIDATIONS)

    @torch.no_grad()
    def _score(self, data: Dataset, index: int) -> float:
        """PSNR in dB; 0 for a frame that is not finite, so that its weights are never the best."""
        frame = FrameModule(self.network, self.encoding)(data.features[index].to(self.device)).cpu().numpy()
        if not np.isfinite(frame).all():
            return 0.0
        exposure = self.encoding.exposure
        return psnr(tone_map(frame, exposure), tone_map(data.target[index].numpy(), exposure))

    # ---------------------------------------------- persistence --------------------------------------------

    def best_state(self) -> dict[str, Tensor]:
        """Weights with the best validation score, the last ones without validation."""
        state = self._best if self._best is not None else self.network.state_dict()
        return {name: value.detach().cpu().contiguous() for name, value in state.items()}

    def description(self) -> dict[str, Any]:
        """What a reader of the weights needs."""
        return {"network": dataclasses.asdict(self.config), "encoding": self.encoding.to_json(),
                "settings": dataclasses.asdict(self.settings), "curve": self.curve}  # fmt: skip

    def save_checkpoint(self) -> None:
        """Commits the state of this step and drops older checkpoints."""
        state = {"network": self.network.state_dict(), "optimizer": self.optimizer.state_dict(),
                 "rng": self.crops.rng.bit_generator.state, "torch_rng": torch.get_rng_state(), "step": self.step,
                 "num_steps": self.num_steps, "skipped": self.skipped, "spent_s": self.spent_s,
                 "next_validation": self.next_validation, "autocast": self.autocast, "curve": self.curve,
                 "norms": list(self.norms), "best": self._best}  # fmt: skip
        save_checkpoint(self.run, self.ref, state)
