"""The kill test in its long form: `make torture`.

Runs the tiny job again and again on a scheduler, two workers and a service, and sends SIGKILL to one of them at random
moments of every stage, until enough were killed. Every job must end complete, and every committed file must be the one
that an undisturbed run in one process makes. Then a trainer alone is killed over and over, and every loss compared.
"""

import argparse
import json
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.torture.crew import ROOT, TRAINER, VICTIMS, Crew
from tests.torture.tiny_job import committed, differences
from tests.torture.trainer import torment_trainer

STAGES = ("start", "census", "elements", "bake", "inputs", "render", "train", "evaluate")
MAX_KILLS_A_STAGE = 2  # of one job: a unit that dies three times is set aside, which is not what is tested here
JOB_SECONDS = 400
TRAINER_KILLS = 8
SETTINGS = {"cache.diffuse_spp": 256, "frames.test_spp": 256}

Kills = Counter[tuple[str, str]]


def torment(crew: Crew, kills: Kills, rng: random.Random, wanted: int, victims: tuple[str, ...] = VICTIMS) -> bool:
    """Kills at random moments until the job is complete; whether it was in time."""
    deadline = time.monotonic() + JOB_SECONDS
    here: Counter[str] = Counter()
    next_s = time.monotonic() + rng.uniform(0.5, 4.0)
    while time.monotonic() < deadline:
        if crew.revive():
            return True
        stage = crew.stage()
        if time.monotonic() < next_s or kills.total() >= wanted or here[stage] >= MAX_KILLS_A_STAGE:
            time.sleep(0.05)
            continue
        victim = min(
            victims if stage != "train" else (*victims, TRAINER), key=lambda v: (kills[v, stage], rng.random())
        )
        if crew.kill(victim, rng):
            kills[victim, stage] += 1
            here[stage] += 1
        next_s = time.monotonic() + rng.uniform(0.1, 4.0)
    return False


def table(kills: Kills) -> str:
    """Kills by victim and stage."""
    victims = (*VICTIMS, TRAINER)
    rows = [["", *STAGES, "all"]]
    for victim in victims:
        counts = [kills[victim, stage] for stage in STAGES]
        rows.append([victim, *map(str, counts), str(sum(count for (v, _), count in kills.items() if v == victim))])
    rows.append(["all", *(str(sum(kills[v, s] for v in victims)) for s in STAGES), str(kills.total())])
    return "\n".join("  ".join(cell.rjust(10) for cell in row) for row in rows)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--folder", type=Path, help="kept for a look afterwards; a temporary one by default")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        return run(arguments.folder or Path(temporary), arguments.kills, arguments.seed, arguments.workers)


def run(folder: Path, wanted: int, seed: int, num_workers: int) -> int:
    rng, kills, bad = random.Random(seed), Counter[tuple[str, str]](), 0
    settings, job_settings = json.dumps(SETTINGS), json.dumps({**SETTINGS, "train.epochs": 12})
    subprocess.run([sys.executable, "-m", "tests.torture.undisturbed", str(folder / "undisturbed"), job_settings],
                   cwd=ROOT, check=True)  # fmt: skip
    expected = committed(folder / "undisturbed")
    job = 0
    while kills.total() < wanted:
        job += 1
        before, start = kills.total(), time.monotonic()
        with Crew(folder / f"job-{job}", num_workers, ["--settings", job_settings]) as crew:
            complete = torment(crew, kills, rng, wanted)
        last = crew.events()[-1] if crew.events() else {}
        found = committed(crew.store) if crew.store.exists() else {}
        wrong = differences(expected, found)
        fine = complete and not wrong and last.get("set_aside") == [] and last.get("evaluation") is True
        bad += not fine
        print(f"job {job}: {kills.total() - before} kills, {time.monotonic() - start:.0f} s, "
              f"{'complete' if complete else 'NOT COMPLETE'}, {crew.restarts} restarts, {crew.failures} failures, "
              f"{len(found)} files, {len(wrong)} differ {wrong[:3]}", flush=True)  # fmt: skip
    print(f"\n{table(kills)}\n\n{job} jobs, {kills.total()} kills, {len(expected)} committed files compared a job, "
          f"{bad} jobs not as they should be (seed {seed})")  # fmt: skip
    trainer_kills, resumed, wrong = torment_trainer(folder / "undisturbed", folder, rng, TRAINER_KILLS, settings)
    print(f"trainer alone: {trainer_kills} kills, {resumed} lives from a checkpoint, {wrong} losses differ")
    return 1 if bad or wrong or not resumed else 0


if __name__ == "__main__":
    sys.exit(main())
