"""Predicted cost of a run: exact paths, seconds from a short calibration of each stage, bytes of the caches.

Bake and frames have calibrations of their own: their paths differ in length, coherence and launch size. Evaluation is
not predicted: it measures times, and takes as long as it is told to.
"""

import time
from dataclasses import dataclass

import numcodecs
import numpy as np
import torch

from models.losses import LossConfig, ReconstructionLoss
from models.network import FusionNet, NetworkConfig
from models.perceptual import MIN_SIZE_PX, StLpips
from models.transfer import Transfer
from storage.perceptual_weights import find_stlpips
from workers.bake_kernels import bake_diffuse, bake_directional
from workers.bake_lobes import DIFFUSE, GATHERED_SHARE, TRACED, TRACED_SHARE
from workers.benchmark import spread_batch
from workers.direction_grids import grid_shares
from workers.elements import ElementSet
from workers.gather import DiffuseGather, gathers
from workers.pathtrace import flush, trace
from workers.pilot import Pilot
from workers.plan import StageCost
from workers.query import CHANNELS
from workers.reconstruct import channels_last
from workers.run_state import RunState
from workers.settings import Settings
from workers.texels import pack_rows

CALIBRATION_PATHS = 1 << 19
CALIBRATION_EDGE_PX = 256
# Records beside the values: JSON of each bake unit and of the set, a part of it for every array.
UNIT_NBYTES, UNIT_ARRAY_NBYTES = 582, 210
SET_NBYTES, SET_ARRAY_NBYTES = 1015, 915
VALUE_NBYTES, TEXEL_NBYTES, TOP_NBYTES = 4, 4, 2


@dataclass(frozen=True, kw_only=True)
class Rates:
    """What this machine does with a scene.

    Attributes:
        elements_s: seconds of placing elements, from this very plan.
        diffuse, directional: element paths a second; 0 where there is no such lobe.
        gathered: of diffuse paths that end in caches; 0 where none do.
        frames: camera paths a second.
        step_s: seconds of one training step, by widths of the network.
    """

    elements_s: float
    diffuse: float
    directional: float
    frames: float
    step_s: dict[tuple[int, ...], float]
    gathered: float = 0.0


def calibrate(run: RunState, elements: ElementSet, widths: set[tuple[int, ...]], elements_s: float) -> Rates:
    """Measures for a few seconds: one warm launch of each kind.

    Args:
        run: the scene and its settings.
        elements: of the run.
        widths: networks that may be trained.
        elements_s: seconds that placing the elements took.
    """
    cache, scene, gather = run.settings.cache, run.scene, None
    diffuse = directional = gathered = 0.0
    if gathers(cache, scene.max_depth, run.table, elements):
        gather = DiffuseGather.of_nothing(scene.mi_scene, run.table, elements)
    if cache.lobes == "split" and len(elements.diffuse):
        diffuse = _diffuse_rate(run, elements, None)
        gathered = 0.0 if gather is None else _diffuse_rate(run, elements, gather)
    if len(elements.glossy):
        grid = (cache.azimuth, cache.polar)
        glossy = spread_batch(elements.glossy, cache.elements_per_unit, grid[0] * grid[1], CALIBRATION_PATHS)
        exitant = cache.lobes == "exitant"
        seconds = _warm_seconds(lambda index: bake_directional(
            scene.mi_scene, run.table, elements, glossy, grid, 1, index, scene.max_depth, exitant, gather))  # fmt: skip
        directional = len(glossy.element) * grid[0] * grid[1] / seconds
    edge = CALIBRATION_EDGE_PX
    camera = scene.camera.resized(min(run.settings.width, edge), min(run.settings.height, edge))
    spp_frames = max(1, CALIBRATION_PATHS // (camera.width * camera.height))
    frames = spp_frames * camera.width * camera.height / _warm_seconds(
        lambda index: trace(scene, camera, spp_frames, index)
    )  # fmt: skip
    step_s = {shape: step_seconds(run.settings.override({"train.widths": shape})) for shape in sorted(widths)}
    return Rates(elements_s=elements_s, diffuse=diffuse, directional=directional, frames=frames, step_s=step_s,
                 gathered=gathered)  # fmt: skip


def _diffuse_rate(run: RunState, elements: ElementSet, gather: DiffuseGather | None) -> float:
    """Paths a second of the diffuse lobe's bake."""
    cache, scene, owners = run.settings.cache, run.scene, elements.diffuse
    spp = min(cache.diffuse_spp, max(1, CALIBRATION_PATHS // min(cache.elements_per_unit, len(owners))))
    batch = spread_batch(owners, cache.elements_per_unit, spp, CALIBRATION_PATHS)
    seconds = _warm_seconds(
        lambda index: bake_diffuse(scene.mi_scene, run.table, elements, batch, spp, index, scene.max_depth, gather)
    )
    return len(batch.element) * spp / seconds


def _warm_seconds(launch) -> float:
    launch(0)
    flush()
    start = time.perf_counter()
    launch(1)
    flush()
    return max(time.perf_counter() - start, 1e-6)


def stage_costs(settings: Settings, elements: ElementSet, rates: Rates, pilot: Pilot) -> tuple[StageCost, ...]:
    """Costs of a run with some settings; `settings` differ from the calibrated run's in nothing but choices."""
    cache, frames = settings.cache, settings.frames
    pixels = settings.width * settings.height
    costs = [StageCost(stage="elements", paths=0, seconds=rates.elements_s, note="as in this plan")]
    for one in _sets(settings, elements, pilot, gathering=rates.gathered > 0):
        per_pass = -(-one.spp // cache.passes)
        paths = one.rows * one.directions * per_pass * cache.passes
        of_diffuse = {DIFFUSE: rates.gathered or rates.diffuse, TRACED: rates.diffuse}
        rate = of_diffuse.get(one.name, rates.directional)
        nbytes = cache_nbytes(one, cache.elements_per_unit)
        costs.append(StageCost(stage=f"bake {one.name}", paths=paths, seconds=paths / rate, nbytes=nbytes,
                               note=_rate_note(paths, rate)))  # fmt: skip
    for name, count, spp in (("training frames", frames.num_train, frames.train_spp),
                             ("validation frames", frames.num_validation, frames.train_spp),
                             ("test references", frames.num_test, frames.test_spp)):  # fmt: skip
        paths = count * spp * pixels
        costs.append(
            StageCost(stage=name, paths=paths, seconds=paths / rates.frames, note=_rate_note(paths, rates.frames))
        )
    return (*costs, _training(settings, rates))


def _rate_note(paths: int, rate: float) -> str:
    return f"{paths / 1e6:.3g} M paths at {rate / 1e6:.2f} M/s"


@dataclass(frozen=True)
class _Set:
    """One cache set: its shape, and a sample of its arrays as they lie in the store."""

    name: str
    rows: int
    directions: int
    spp: int
    row_nbytes: int
    arrays: int
    samples: list[np.ndarray]


def _sets(settings: Settings, elements: ElementSet, pilot: Pilot, *, gathering: bool) -> list[_Set]:
    cache, sets = settings.cache, list[_Set]()
    if cache.lobes == "split" and len(elements.diffuse):
        plain = pilot.samples.get("diffuse", [])
        shares = {TRACED: TRACED_SHARE, DIFFUSE: GATHERED_SHARE} if gathering else {DIFFUSE: 1}
        for name, divisor in shares.items():
            spp = -(-cache.diffuse_spp // divisor)
            sets.append(_Set(name, len(elements.diffuse), 1, spp, 2 * 3 * VALUE_NBYTES, 2, plain))
    packs = cache.texels == "rgb9e5" and cache.lobes == "split"
    floats = pilot.samples.get("directional", [])
    # Signed or not makes no difference to the size.
    samples = [array for rows in floats for array in pack_rows(rows, signed=False).values()] if packs else floats
    for share in grid_shares(elements, cache):
        directions = share.grid[0] * share.grid[1]
        row_nbytes = directions * TEXEL_NBYTES + TOP_NBYTES if packs else directions * 3 * VALUE_NBYTES
        sets.append(_Set(share.name, share.rows, directions, share.spp, row_nbytes, 2 if packs else 1, samples))
    return sets


def cache_nbytes(one: _Set, rows_per_unit: int) -> int:
    """Bytes of a cache set at rest: its values, compressed as well as the pilot's, and its records."""
    units = -(-one.rows // rows_per_unit)
    records = units * (UNIT_NBYTES + UNIT_ARRAY_NBYTES * one.arrays) + SET_NBYTES + SET_ARRAY_NBYTES * one.arrays
    return int(one.rows * one.row_nbytes * compressed_share(one.samples)) + records


def compressed_share(samples: list[np.ndarray]) -> float:
    """Size of some arrays when compressed as the store does; 1 without any."""
    raw = sum(sample.nbytes for sample in samples)
    codec = numcodecs.Zstd(level=1)
    packed = sum(len(codec.encode(np.ascontiguousarray(sample))) for sample in samples)
    return packed / raw if raw else 1.0


# ------------------------------------------------- training -----------------------------------------------


def _training(settings: Settings, rates: Rates) -> StageCost:
    train = settings.train
    step_s = rates.step_s[tuple(train.widths)]
    crop = _crop(settings)
    crops = max(1, round(settings.frames.num_train * settings.width * settings.height / crop**2))
    steps = train.epochs * -(-crops // train.batch)
    seconds = steps * step_s
    limited = 0 < train.seconds < seconds
    note = f"{steps} steps of {1e3 * step_s:.0f} ms" + (f"; ended after {train.seconds:.0f} s" if limited else "")
    return StageCost(stage="training", paths=0, seconds=train.seconds if limited else seconds, note=note)


def _crop(settings: Settings) -> int:
    multiple = NetworkConfig(widths=settings.train.widths, unshuffle=settings.train.unshuffle).size_multiple  # type: ignore[arg-type]  # three, by the settings' own check
    smallest = max(multiple, min(settings.width, settings.height))
    return max(multiple, min(settings.train.crop, smallest) // multiple * multiple)


def step_seconds(settings: Settings) -> float:
    """Seconds of a training step of the network that some settings describe, on noise: the mean over one round of the
    perceptual term, in the faster of the precisions that training may choose."""
    train = settings.train
    config = NetworkConfig(
        gbuffer_channels=CHANNELS["distance"][1] - CHANNELS["normal"][0], widths=train.widths,  # type: ignore[arg-type]
        fusion=train.fusion, unshuffle=train.unshuffle, residual=train.residual,
        negative_slope=train.negative_slope,
    )  # fmt: skip
    network = channels_last(FusionNet(config))
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-4)
    losses = _losses(settings)
    generator = torch.Generator().manual_seed(0)
    shape = (train.batch, config.ir_channels + config.gbuffer_channels + 3, _crop(settings), _crop(settings))
    noise = torch.rand(shape, generator=generator)
    ir, gbuffer, target = (part.contiguous(memory_format=torch.channels_last) for part in noise.split(
        [config.ir_channels, config.gbuffer_channels, 3], dim=1))  # fmt: skip

    def step(index: int, autocast: bool) -> None:
        optimizer.zero_grad(set_to_none=True)
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=autocast):
            output = network(ir, gbuffer)
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=autocast):
            terms = losses[0 if index % max(train.perceptual_every, 1) == 0 else 1](output.float(), target)
        terms["total"].backward()
        optimizer.step()

    seconds = []
    for autocast in {"fp32": (False,), "bf16": (True,), "auto": (False, True)}[train.precision]:
        step(0, autocast)
        count = max(train.perceptual_every, 2)
        start = time.perf_counter()
        for index in range(count):
            step(index, autocast)
        seconds.append((time.perf_counter() - start) / count)
    return min(seconds)


def _losses(settings: Settings) -> tuple[ReconstructionLoss, ReconstructionLoss]:
    """(with the perceptual term, without), as training takes them."""
    transfer = Transfer(curve="mu-law")
    weights = find_stlpips() if settings.train.perceptual_weight > 0 and _crop(settings) >= MIN_SIZE_PX else None
    perceptual = None if weights is None else StLpips(weights["alex"] if "alex" in weights else weights["vgg"])
    l1 = settings.train.l1_weight or 1.0
    plain = ReconstructionLoss(LossConfig(l1=l1, perceptual=0.0), transfer=transfer)
    if perceptual is None:
        return plain, plain
    return ReconstructionLoss(LossConfig(l1=l1, perceptual=0.1), transfer=transfer, perceptual=perceptual), plain
