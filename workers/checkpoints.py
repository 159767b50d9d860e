"""Checkpoints of a training run: units of their own, committed as any other, dropped when the network is."""

from typing import Any

from storage.store import UnitRef
from storage.weights import decode_checkpoint, encode_checkpoint
from workers.run_state import RunState

CHECKPOINT_STAGE = "checkpoint"
CHECKPOINT_FILE = "checkpoint.pt"


def save_checkpoint(run: RunState, ref: UnitRef, state: dict[str, Any]) -> None:
    """Commits a trainer's state and drops the older ones of its run.

    Args:
        run: whose store takes it.
        ref: the unit that the training makes.
        state: of tensors and plain values; "step" says how far it came.
    """
    params = {"train": ref.key, "step": state["step"]}
    checkpoint = run.ref(CHECKPOINT_STAGE, params)
    older = checkpoints(run, ref)
    run.store.commit(checkpoint, {CHECKPOINT_FILE: encode_checkpoint(state)}, params)
    for old in older:
        if old != checkpoint:
            run.store.discard(old)


def load_checkpoint(run: RunState, ref: UnitRef) -> dict[str, Any] | None:
    """The state with the most steps; None where there is none."""
    found = latest_checkpoint(run, ref)
    return None if found is None else decode_checkpoint(run.store.read(found, CHECKPOINT_FILE))


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
