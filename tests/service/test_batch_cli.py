"""`lightwell batch`, `lightwell dataset` and `lightwell export`: what they print and write, and how they fail."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from service.batch_cli import _parse_inputs
from service.cli import app
from service.errors import OptionError
from storage.store import Store
from workers.settings import Settings

BATCH = """
scenes: [tiny{more}]
presets: [tiny]
variations: [{{name: bright, light: [2, 4]}}]
resolution: [16, 16]
settings: {{frames.num_train: 1, frames.num_test: 1, frames.train_spp: 4, frames.test_spp: 4}}
"""
SMALL = ["--set", "frames.num_train=1", "--set", "frames.num_test=1",
         "--set", "frames.train_spp=4", "--set", "frames.test_spp=4", "--resolution", "16x16"]  # fmt: skip


def invoke(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def batch_file(folder: Path, more: str = "") -> Path:
    path = folder / "batch.yaml"
    path.write_text(BATCH.format(more=more))
    return path


def test_plan_run_and_dataset_follow_each_other(tmp_path: Path) -> None:
    batch, store = batch_file(tmp_path), tmp_path / "store"
    planned = invoke("batch", "plan", batch, "--store", store)
    assert planned.exit_code == 0, planned.output
    assert "6 of 6 frames to render" in planned.output and "1 combinations" in planned.output
    ran = invoke("batch", "run", batch, "--store", store, "--json", tmp_path / "run.json")
    assert ran.exit_code == 0, ran.output
    assert json.loads((tmp_path / "run.json").read_text())["combinations"][0]["num_rendered"] == 6
    written = invoke("dataset", batch, "--store", store, "--output", tmp_path / "dataset")
    assert written.exit_code == 0, written.output
    assert "3 frames of 1 variants (1 train, 1 valid, 1 test)" in written.output
    assert "0 of 6 frames rendered" in written.output


def test_failed_combination_leaves_the_others_and_exit_code_1(tmp_path: Path) -> None:
    result = invoke("dataset", batch_file(tmp_path, ", none.xml"), "--store", tmp_path / "store", "--output",
                    tmp_path / "dataset")  # fmt: skip
    assert result.exit_code == 1
    assert "1 of 2 combinations complete" in result.output and "none.xml" in result.output
    assert len(json.loads((tmp_path / "dataset" / "manifest.json").read_text())["frames"]) == 3


def test_dataset_of_one_scene_by_file_and_by_its_name_in_the_store(tmp_path: Path) -> None:
    store = tmp_path / "store"
    result = invoke("dataset", "--scene", "tiny", "--preset", "tiny", *SMALL, "--inputs", "none", "--store", store,
                    "--output", tmp_path / "a")  # fmt: skip
    assert result.exit_code == 0, result.output
    opened = Store.open(store)
    (entry,) = opened.scenes()
    settings = Settings.preset_named("tiny").override(dict(part.split("=") for part in SMALL[1:8:2]))
    settings = settings.override({"width": 16, "height": 16})
    opened.register_scene(entry["digest"], {**entry, "settings": settings.to_json()})
    again = invoke("dataset", "--scene", "tiny", "--inputs", "none", "--store", store, "--output", tmp_path / "b")
    assert again.exit_code == 0, again.output
    assert "0 of 3 frames rendered" in again.output
    frames = [json.loads((tmp_path / name / "manifest.json").read_text())["frames"] for name in "ab"]
    assert [frame["images"] for frame in frames[0]] == [frame["images"] for frame in frames[1]]


@pytest.mark.parametrize(("arguments", "words"), [
    (["dataset"], "one of the two"),
    (["dataset", "x.yaml", "--scene", "tiny"], "one of the two"),
    (["dataset", "--scene", "tiny", "--split", "day"], "--split must be path or scene"),
    (["dataset", "--scene", "tiny", "--inputs", "0"], "--inputs must be"),
    (["dataset", "--scene", "tiny#colour=1"], "failed"),
    (["batch", "run", "none.yaml"], "readable YAML"),
    (["export", "tiny"], ".onnx file"),
])  # fmt: skip
def test_mistakes_are_one_line(tmp_path: Path, arguments: list[str], words: str) -> None:
    output = [] if arguments[0] == "batch" else ["--output", tmp_path / "out"]
    result = invoke(*arguments, "--store", tmp_path / "store", *output)
    assert result.exit_code == 2, result.output
    assert words in result.stderr and "Traceback" not in result.output


def test_export_names_the_scene_that_was_not_trained(tmp_path: Path) -> None:
    Store.open(tmp_path / "store", create=True).register_scene("d1", {"name": "hall", "source": "hall.xml"})
    result = invoke("export", "hall", "--store", tmp_path / "store", "-o", tmp_path / "net.onnx")
    assert result.exit_code == 2 and "must have a trained network" in result.stderr
    assert not (tmp_path / "net.onnx").exists()


def test_inputs_are_sorted_and_none_is_none() -> None:
    assert _parse_inputs("4, 1,4") == (1, 4)
    assert _parse_inputs("none") == ()
    with pytest.raises(OptionError, match="--inputs"):
        _parse_inputs("1.5")
