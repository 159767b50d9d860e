"""A trainer alone, killed over and over: after each resume every loss must be the one of a trainer left in peace.

As a script, it trains on a store that holds inputs and frames, and writes each step's loss: STORE LOG.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]
EPOCHS = 30


def train(store_url: str, log: Path, settings: dict[str, object]) -> None:
    """Runs the trainer from its last checkpoint; "step loss" in hexadecimal, line by line."""
    from tests.torture.tiny_job import tiny_spec
    from workers.inputs import inputs_ref
    from workers.loaded_run import open_run
    from workers.progress import Progress
    from workers.render import render_ref
    from workers.train import train_ref
    from workers.trainer import Trainer
    from workers.training_data import load_dataset

    loaded = open_run(tiny_spec(**settings, **{"train.epochs": EPOCHS}), store_url, Progress())
    run, spp = loaded.run, loaded.run.settings.frames.train_spp
    inputs = [inputs_ref(run, loaded.elements, camera) for camera in run.paths.train]
    renders = [render_ref(run, camera, spp) for camera in run.paths.train]
    trainer = Trainer(run, train_ref(run, inputs, renders), load_dataset(run, inputs, renders), None)
    step_once = trainer.train_step
    with log.open("a") as out:
        out.write(f"from {trainer.step}\n")

        def logged() -> dict[str, float]:
            step, terms = trainer.step, step_once()
            out.write(f"{step} {terms['total'].hex()}\n")
            out.flush()
            return terms

        trainer.train_step = logged  # type: ignore[method-assign]
        trainer.fit()


def torment_trainer(
    store: Path, folder: Path, rng: random.Random, num_kills: int, settings: str
) -> tuple[int, int, int]:
    """Kills a trainer at random moments of its work.

    Returns:
        Kills, lives that went on from a checkpoint, and losses that differ from those of a trainer left in peace.
    """
    logs = {}
    for name, kills in (("peace", 0), ("killed", num_kills)):
        copy, logs[name] = folder / f"{name}-store", folder / f"{name}.log"
        shutil.copytree(store, copy)
        done = 0
        while True:
            process = _start(copy, logs[name], settings)
            if done < kills and _kill_at_work(process, logs[name], rng):
                done += 1
            elif process.wait() == 0:
                break
    peace, lives = _losses(logs["peace"]), _lives(logs["killed"])
    wrong = sum(peace.get(step) != loss for step, loss in _all_losses(logs["killed"]))
    wrong += _losses(logs["killed"]).keys() != peace.keys()
    return done, sum(life > 0 for life in lives), wrong


def _start(store: Path, log: Path, settings: str) -> subprocess.Popen[bytes]:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "LIGHTWELL_CHECKPOINT_SECONDS": "0.3"}
    return subprocess.Popen(
        [sys.executable, "-m", "tests.torture.trainer", str(store), str(log), settings], cwd=ROOT, env=environment
    )


def _kill_at_work(process: subprocess.Popen[bytes], log: Path, rng: random.Random) -> bool:
    """Waits for some steps of this life, then kills; whether the trainer was still at work."""
    before = len(_all_losses(log))
    more = rng.randint(1, 60)
    while process.poll() is None and len(_all_losses(log)) < before + more:
        time.sleep(0.02)
    if process.poll() is not None:
        return False
    process.send_signal(signal.SIGKILL)
    return process.wait() == -signal.SIGKILL


def _rows(log: Path) -> list[list[str]]:
    """Lines that were written whole."""
    text = log.read_text() if log.exists() else ""
    return [line.split() for line in text.rpartition("\n")[0].splitlines()]


def _all_losses(log: Path) -> list[tuple[int, str]]:
    return [(int(step), loss) for step, loss in _rows(log) if step != "from"]


def _losses(log: Path) -> dict[int, str]:
    return dict(_all_losses(log))


def _lives(log: Path) -> list[int]:
    return [int(step) for word, step in _rows(log) if word == "from"]


if __name__ == "__main__":
    import json

    from workers.thread_policy import ThreadPolicy

    policy = ThreadPolicy()
    os.environ.update(policy.environment)
    policy.apply("train")
    train(sys.argv[1], Path(sys.argv[2]), json.loads(sys.argv[3]))
