"""The kill test in its short forms: with stages that answer at once, and (slow) with real ones."""

import json
import os
import random
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from service.engine import DaskRunner
from tests.torture.crew import ROOT, VICTIMS, Crew
from tests.torture.tiny_job import committed, differences, tiny_spec
from tests.torture.torture import run, torment
from workers.thread_policy import ThreadPolicy

UNITS = 1 + 1 + 1 + 6 + 20 + 1 + 4 + 1 + 1


@pytest.mark.timeout(120)
def test_job_survives_the_death_of_worker_scheduler_and_service(tmp_path: Path) -> None:
    """One worker, so that whatever dies is missed; kills of every kind, each followed by a restart."""
    stages = tmp_path / "stages"
    stages.mkdir()
    kills: Counter[tuple[str, str]] = Counter()
    options = ["--fake", str(stages), "--settings", json.dumps({"seconds": 0.15})]
    with Crew(tmp_path / "crew", 1, options) as crew:
        complete = torment(crew, kills, random.Random(4), wanted=3, victims=("scheduler", "service", "worker"))
        events = crew.events()
    assert complete
    assert kills.total() == 3
    assert crew.restarts >= 2, "scheduler and service by us; the worker's process by its nanny"
    assert events[-1]["kind"] == "done" and events[-1]["set_aside"] == [] and events[-1]["evaluation"]
    ended = Counter((stages / "ended").read_text().splitlines())
    assert len(ended) == UNITS
    again = {name for name, count in ended.items() if count > 1} - {"census", "inventory", "train", "evaluate"}
    assert len(again) <= kills.total(), "only what was in flight is done again"


@pytest.mark.slow
def test_job_of_real_stages_survives_kills_with_identical_bytes(tmp_path: Path) -> None:
    assert run(tmp_path, wanted=len(VICTIMS) + 2, seed=1, num_workers=2) == 0


@pytest.mark.slow
def test_job_on_two_workers_makes_the_pipelines_bytes(tmp_path: Path) -> None:
    subprocess.run(
        [sys.executable, "-m", "tests.torture.undisturbed", str(tmp_path / "one"), "{}"],
        cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=True,
    )  # fmt: skip
    with DaskRunner(str(tmp_path / "two"), num_workers=2, threads=ThreadPolicy()) as runner:
        result = runner.run("job", tiny_spec(), lambda event: None, lambda: None)
    assert result["set_aside"] == []
    assert result["evaluation"]["rows"][0]["non_finite"] == 0
    assert differences(committed(tmp_path / "one"), committed(tmp_path / "two")) == []
