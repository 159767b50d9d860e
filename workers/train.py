"""Stage `train`: fits the reconstruction network of one scene, unless the store has it."""

import dataclasses
import time

from storage.store import UnitRef
from workers.checkpoints import discard_checkpoints
from workers.network_record import network_files
from workers.run_state import RunState
from workers.trainer import Trainer
from workers.training_data import load_dataset

STAGE = "train"


def train_ref(run: RunState, inputs: list[UnitRef], renders: list[UnitRef]) -> UnitRef:
    """The unit that holds the trained network."""
    params = {"train": dataclasses.asdict(run.settings.train), "inputs": [r.key for r in inputs],
              "renders": [r.key for r in renders], "denoise": run.settings.frames.denoise_train}  # fmt: skip
    return run.ref(STAGE, params)


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
    record = {"seconds": seconds, "steps": trainer.step, "curve": trainer.curve, "non_finite_steps": trainer.skipped}
    run.store.commit(ref, network_files(trainer.best_state(), trainer.description()), record)
    discard_checkpoints(run, ref)
    run.seconds[STAGE] = seconds
    return ref
