"""Stage `train`: fits the reconstruction network of one scene; resumes exactly from its checkpoint."""

import dataclasses
import os
import time
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from models.losses import LossConfig, ReconstructionLoss
from models.metrics import exposure_from_luminance, luminance, psnr, tone_map
from models.network import FusionNet, NetworkConfig
from models.perceptual import MIN_SIZE_PX, StLpips
from models.transfer import Transfer
from storage.perceptual_weights import find_stlpips
from storage.store import Store, UnitRef
from storage.weights import decode_checkpoint, decode_network, encode_checkpoint, encode_network
from workers.errors import StoppedError, WorkerError
from workers.inputs import load_inputs
from workers.query import CHANNELS, NUM_CHANNELS
from workers.reconstruct import GBUFFER_CHANNELS, Encoding, FrameModule, channels_last, pad_to_multiple
from workers.render import load_render
from workers.run_state import RunState
from workers.schedule import learning_rate

STAGE = "train"
CHECKPOINT_STAGE = "checkpoint"
WEIGHTS_FILE, CONFIG_FILE, CHECKPOINT_FILE = "network.safetensors", "network.json", "checkpoint.pt"
CHECKPOINT_SECONDS = float(os.environ.get("LIGHTWELL_CHECKPOINT_SECONDS", "60"))
VALIDATIONS = 20
PROBE_STEPS = 8


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


def train_ref(run: RunState, inputs: list[UnitRef], renders: list[UnitRef]) -> UnitRef:
    """The unit that holds the trained network."""
    params = {"train": dataclasses.asdict(run.settings.train), "inputs": [r.key for r in inputs],
              "renders": [r.key for r in renders], "denoise": run.settings.frames.denoise_train}  # fmt: skip
    return run.ref(STAGE, params)


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


def run_train(run: RunState, train: tuple[list[UnitRef], list[UnitRef]],
              validation: tuple[list[UnitRef], list[UnitRef]]) -> UnitRef:  # fmt: skip
    """Trains unless the store has the network; both arguments are (input units, render units)."""
    ref = train_ref(run, *train)
    if run.store.committed(ref) is not None:
        discard_checkpoints(run, ref)  # of a process that ended between the commit and this line
        return ref
    start = time.perf_counter()
    trainer = Trainer(run, ref, load_dataset(run, *train), load_dataset(run, *validation) if validation[0] else None)
    trainer.fit()
    seconds = time.perf_counter() - start
    weights, config = encode_network(trainer.best_state(), trainer.description())
    record = {"seconds": seconds, "steps": trainer.step, "curve": trainer.curve, "non_finite_steps": trainer.skipped}
    run.store.commit(ref, {WEIGHTS_FILE: weights, CONFIG_FILE: config}, record)
    discard_checkpoints(run, ref)
    run.seconds[STAGE] = seconds
    return ref


def load_network(run: RunState, ref: UnitRef) -> tuple[FusionNet, Encoding]:
    """Reads a trained network."""
    return read_network(run.store, ref)


def read_network(store: Store, ref: UnitRef) -> tuple[FusionNet, Encoding]:
    """Reads a trained network; the scene itself is not needed."""
    state, config = decode_network(store.read(ref, WEIGHTS_FILE), store.read(ref, CONFIG_FILE))
    values = config["network"]
    network = FusionNet(NetworkConfig(**{**values, "widths": tuple(values["widths"])}))
    network.load_state_dict(state)
    return network, Encoding.from_json(config["encoding"])


class Trainer:
    """Model, optimizer, schedule, random state and data cursor of one training run."""

    def __init__(self, run: RunState, ref: UnitRef, train: Dataset, validation: Dataset | None) -> None:
        self.run, self.ref, self.settings = run, ref, run.settings.train
        self.train_set, self.validation_set = train, validation
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.encoding = _encoding(train, self.settings.transfer)
        seed = run.seed(ref)
        torch.manual_seed(seed)
        self.config = NetworkConfig(
            ir_channels=3, gbuffer_channels=GBUFFER_CHANNELS, widths=tuple(self.settings.widths),  # type: ignore[arg-type]  # three, by the settings' own check
            fusion=self.settings.fusion, unshuffle=self.settings.unshuffle, residual=self.settings.residual,
        )  # fmt: skip
        self.network = channels_last(FusionNet(self.config).to(self.device))
        self.optimizer = self._optimizer()
        self._encode_sets()
        self.loss, self.plain_loss = self._losses()
        self.rng = np.random.default_rng(seed)
        self.step, self.num_steps, self.skipped = 0, 0, 0
        self.autocast = False
        self.curve: list[dict[str, float]] = []
        self._best: dict[str, Tensor] | None = None
        self._resume()

    # ------------------------------------------------ set-up ------------------------------------------------

    def _losses(self) -> tuple[ReconstructionLoss, ReconstructionLoss]:
        """The loss with its perceptual term and the one of the steps between."""
        settings = self.settings
        perceptual = None
        if 0 < self._crop_size() < MIN_SIZE_PX:
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

    def _encode_sets(self) -> None:
        """Frames in network space, kept channels-last."""
        ir, gbuffer = self.encoding.inputs(self.train_set.features)
        exposed = self.train_set.target * self.encoding.exposure
        target = self.encoding.transfer.forward(exposed).permute(0, 3, 1, 2)
        # Frames smaller than the network's multiple are padded, as at inference; larger ones are cropped to it.
        if min(target.shape[-2:]) < self.config.size_multiple:
            ir, gbuffer, target = (pad_to_multiple(x, self.config.size_multiple) for x in (ir, gbuffer, target))
        self.ir, self.gbuffer, self.target = ir, gbuffer, target

    def _resume(self) -> None:
        found = latest_checkpoint(self.run, self.ref)
        if found is None:
            return
        state = decode_checkpoint(self.run.store.read(found, CHECKPOINT_FILE))
        self.network.load_state_dict(state["network"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.rng.bit_generator.state = state["rng"]
        torch.set_rng_state(state["torch_rng"])
        self.step, self.num_steps, self.skipped = state["step"], state["num_steps"], state["skipped"]
        self.autocast = state["autocast"]
        self.curve, self._best = state["curve"], state["best"]

    # ----------------------------------------------- training ----------------------------------------------

    def fit(self) -> None:
        """Runs the remaining steps."""
        self.num_steps = self.num_steps or self._planned_steps()
        every = max(1, self.num_steps // VALIDATIONS)
        saved = time.perf_counter()
        if self.step == 0:
            self._validate()
        with self.run.progress.track("train", self.num_steps) as advance:
            advance(self.step)
            while self.step < self.num_steps:
                terms = self.train_step()
                if self.step % every == 0 or self.step == self.num_steps:
                    self._validate()
                last = self.curve[-1].get("psnr")
                try:
                    advance(1, f"loss {terms['total']:.4f}" + (f", validation {last:.2f} dB" if last else ""))
                except StoppedError:
                    self.save_checkpoint()
                    raise
                if time.perf_counter() - saved > CHECKPOINT_SECONDS:
                    self.save_checkpoint()
                    saved = time.perf_counter()

    def _planned_steps(self) -> int:
        """Chooses the precision and the number of steps: all epochs, fewer where the time budget ends first.

        Both are measured over a few steps, then undone and fixed, so that a resumed run keeps them.
        """
        settings = self.settings
        full = max(1, settings.epochs * self._steps_per_epoch())
        if settings.seconds <= 0 and settings.precision == "fp32":
            return full
        seconds = {False: self._probe(full, False)}
        if settings.precision != "fp32":
            seconds[True] = self._probe(full, True)
        self.autocast = settings.precision == "bf16" or min(seconds, key=lambda key: seconds[key])
        if settings.seconds <= 0:
            return full
        return int(np.clip(settings.seconds / seconds[self.autocast], 1, full))

    def _probe(self, num_steps: int, autocast: bool) -> float:
        """Mean seconds of a step; leaves weights, optimizer, random state and cursor as they were."""
        state = {name: value.clone() for name, value in self.network.state_dict().items()}
        rng, torch_rng, skipped = self.rng.bit_generator.state, torch.get_rng_state(), self.skipped
        self.num_steps, self.autocast = num_steps, autocast
        self.train_step()
        start = time.perf_counter()
        for _ in range(PROBE_STEPS):
            self.train_step()
        seconds = (time.perf_counter() - start) / PROBE_STEPS
        self.network.load_state_dict(state)
        self.optimizer = self._optimizer()
        self.rng.bit_generator.state, self.step, self.num_steps, self.skipped = rng, 0, 0, skipped
        torch.set_rng_state(torch_rng)
        return seconds

    def _optimizer(self) -> torch.optim.Optimizer:
        return torch.optim.Adam(self.network.parameters(), lr=self.settings.learning_rate, betas=(0.9, 0.999))

    def _crops_per_epoch(self) -> int:
        """Crops that cover every training pixel once."""
        height, width = self.target.shape[-2:]
        return max(1, round(len(self.train_set) * height * width / self._crop_size() ** 2))

    def _crop_size(self) -> int:
        multiple = self.config.size_multiple
        smallest = min(self.target.shape[-2:])
        return max(multiple, min(self.settings.crop, smallest) // multiple * multiple)

    def train_step(self) -> dict[str, float]:
        """One optimizer step on random crops; returns the loss terms."""
        ir, gbuffer, target = self._batch()
        lr = learning_rate(self.settings, self.step, self.num_steps, self._steps_per_epoch())
        for group in self.optimizer.param_groups:
            group["lr"] = lr
        self.optimizer.zero_grad(set_to_none=True)
        with torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=self.autocast):
            output = self.network(ir, gbuffer)
        terms = self._loss_terms(output.float(), target)
        terms["total"].backward()
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.settings.clip_norm)
        if torch.isfinite(norm):
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

    def _loss_terms(self, output: Tensor, target: Tensor) -> dict[str, Tensor]:
        """The loss; its perceptual term costs several network passes, so it is taken on every
        `perceptual_every`-th step with that much more weight."""
        every = self.settings.perceptual_every
        takes_perceptual = self.step % every == 0 or self.settings.l1_weight == 0
        with torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=self.autocast):
            return (self.loss if takes_perceptual else self.plain_loss)(output, target)

    def _steps_per_epoch(self) -> int:
        return max(1, -(-self._crops_per_epoch() // self.settings.batch))

    def _batch(self) -> tuple[Tensor, Tensor, Tensor]:
        size = self._crop_size()
        height, width = self.target.shape[-2:]
        parts: list[list[Tensor]] = [[], [], []]
        for _ in range(self.settings.batch):
            frame = int(self.rng.integers(len(self.train_set)))
            y = int(self.rng.integers(height - size + 1)) if height >= size else 0
            x = int(self.rng.integers(width - size + 1)) if width >= size else 0
            for part, source in zip(parts, (self.ir, self.gbuffer, self.target), strict=True):
                part.append(source[frame, :, y : y + size, x : x + size])
        batch = [torch.stack(part).to(self.device, memory_format=torch.channels_last) for part in parts]
        return batch[0], batch[1], batch[2]

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
        params = {"train": self.ref.key, "step": self.step}
        ref = self.run.ref(CHECKPOINT_STAGE, params)
        state = {"network": self.network.state_dict(), "optimizer": self.optimizer.state_dict(),
                 "rng": self.rng.bit_generator.state, "torch_rng": torch.get_rng_state(), "step": self.step,
                 "num_steps": self.num_steps, "skipped": self.skipped, "autocast": self.autocast, "curve": self.curve,
                 "best": self._best}  # fmt: skip
        older = checkpoints(self.run, self.ref)
        self.run.store.commit(ref, {CHECKPOINT_FILE: encode_checkpoint(state)}, params)
        for old in older:
            if old != ref:
                self.run.store.discard(old)


def checkpoints(run: RunState, ref: UnitRef) -> list[UnitRef]:
    """Checkpoints of a training run."""
    found = []
    for candidate in run.store.units(run.scene.digest, CHECKPOINT_STAGE):
        record = run.store.committed(candidate)
        if record is not None and record.get("train") == ref.key:
            found.append(candidate)
    return found


def latest_checkpoint(run: RunState, ref: UnitRef) -> UnitRef | None:
    """The checkpoint with the most steps."""

    def step(candidate: UnitRef) -> int:
        record = run.store.committed(candidate)
        return int(record["step"]) if record else -1

    return max(checkpoints(run, ref), key=step, default=None)


def discard_checkpoints(run: RunState, ref: UnitRef) -> None:
    """Drops what a finished run no longer needs."""
    for candidate in checkpoints(run, ref):
        run.store.discard(candidate)


def _encoding(train: Dataset, curve: str) -> Encoding:
    targets = train.target.numpy()
    exposure = exposure_from_luminance([luminance(frame) for frame in targets])
    a = CHANNELS["distance"][0]
    farthest = float(train.features[..., a].max())
    name: Literal["log1p", "mu-law"] = "log1p" if curve == "log1p" else "mu-law"
    return Encoding(exposure, farthest if farthest > 0 else 1.0, Transfer(curve=name))
