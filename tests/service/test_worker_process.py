"""The `lightwell worker` command and what its processes settle before anything heavy is imported."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.cli import app
from service.cluster import DASK_CONFIG, PRELOAD, gpu_resources
from workers.errors import WorkerError
from workers.thread_policy import VARIABLE, ThreadPolicy

ROOT = Path(__file__).parents[2]


def test_policy_comes_back_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    assert ThreadPolicy.from_environment() is None
    for name, value in ThreadPolicy(2, 5).environment.items():
        monkeypatch.setenv(name, value)
    assert ThreadPolicy.from_environment() == ThreadPolicy(2, 5)


def test_policy_refuses_no_threads() -> None:
    with pytest.raises(WorkerError, match="threads must be at least 1, got 0 and 1"):
        ThreadPolicy(0, 1)


def test_preload_settles_threads_before_torch_and_drjit() -> None:
    """In a process of its own, as a worker's is."""
    code = (
        "import json, os, sys, importlib; importlib.import_module(sys.argv[1]); "
        "heavy = [name for name in ('torch', 'drjit', 'mitsuba') if name in sys.modules]; "
        "print(json.dumps([heavy, os.environ['OMP_NUM_THREADS'], os.environ['OMP_WAIT_POLICY']]))"
    )
    environment = {**os.environ, "OMP_NUM_THREADS": "7", VARIABLE: "1,3", "PYTHONPATH": str(ROOT)}
    answer = subprocess.run([sys.executable, "-c", code, PRELOAD], env=environment, capture_output=True, check=True)
    assert json.loads(answer.stdout) == [[], "3", "passive"]


def test_stages_get_their_threads() -> None:
    code = (
        "import torch; from workers.backend import dr; from workers.thread_policy import ThreadPolicy\n"
        "policy = ThreadPolicy(1, 2)\n"
        "for stage in ('bake', 'train', 'render'):\n"
        "    policy.apply(stage); print(stage, dr.thread_count(), torch.get_num_threads())\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    answer = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, check=True, text=True
    ).stdout
    assert answer.splitlines() == ["bake 1 1", "train 2 2", "render 1 1"]


def test_workers_of_a_cluster_load_the_preload_and_keep_the_services_threads() -> None:
    assert DASK_CONFIG["distributed.worker.preload"] == [PRELOAD]
    assert DASK_CONFIG["distributed.nanny.pre-spawn-environ"] == {}, "would set OMP_NUM_THREADS=1 in the service too"


def test_gpu_is_a_resource_where_a_driver_is_loaded() -> None:
    assert gpu_resources() == ({"gpu": 1.0} if Path("/proc/driver/nvidia/version").exists() else {})


def test_worker_command_tells_its_options() -> None:
    result = CliRunner().invoke(app, ["worker", "--help"], env={"COLUMNS": "200", "NO_COLOR": "1"})
    assert result.exit_code == 0
    for option in ("--scheduler", "--threads", "--train-threads", "--memory-limit", "--name"):
        assert option in result.output
