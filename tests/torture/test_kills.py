"""The kill test in its short forms: with stages that answer at once, and (slow) with real ones."""

import json
import random
from collections import Counter
from pathlib import Path

import pytest

from tests.torture.crew import VICTIMS, Crew
from tests.torture.torture import run, torment

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
