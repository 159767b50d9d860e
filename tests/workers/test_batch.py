"""Batches: what a file expands to, what is rendered and what is found, and combinations that fail."""

from pathlib import Path

import pytest

from storage.store import Store
from workers import batch as batch_module
from workers.batch import plan_batch, run_batch
from workers.batch_frames import frame_units
from workers.batch_matrix import BatchError, BatchItem, Matrix, derived_seed, expand, read_matrix
from workers.errors import WorkerError
from workers.progress import Progress
from workers.run_state import RunState
from workers.scene import load_scene
from workers.settings import Settings

SMALL = {"frames.num_train": 2, "frames.num_test": 1, "frames.train_spp": 4, "frames.test_spp": 8}
COLOURS = {"name": "colours", "count": 2, "materials": 0.7, "light": [0.5, 2.0], "camera": 0.1}


def matrix(**values: object) -> Matrix:
    content = {"scenes": ["tiny"], "presets": ["tiny"], "settings": SMALL, "resolution": [16, 16], **values}
    return Matrix.model_validate(content)


def items(**values: object) -> list[BatchItem]:
    return expand(matrix(**values), Path("."))


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store.open(tmp_path / "store", create=True)


def test_matrix_is_the_product_of_its_rows(tmp_path: Path) -> None:
    path = tmp_path / "batch.yaml"
    path.write_text("""
scenes: [tiny, tabletop]
presets: [draft, {name: draft, label: wide, settings: {width: 384}}]
variations:
  - name: original
  - {name: colours, count: 3, materials: 0.7, light: [0.5, 2.0]}
  - {name: brighter, light: 3}
""")
    found = read_matrix(path)
    assert len(found) == 2 * 2 * (1 + 3 + 1)
    assert len({item.label for item in found}) == len(found)
    assert found[0].label == "tiny/draft/original" and found[0].scene == "tiny"
    assert found[2].label == "tiny/draft/colours-0" and found[2].scene.startswith("tiny#seed=")
    assert found[3].overrides == {"width": 384} and found[3].scene == found[2].scene
    brighter = next(item for item in found if item.label == "tabletop/wide/brighter")
    assert brighter.variation is not None and brighter.variation.light == (3.0, 3.0)
    assert [item.scene for item in read_matrix(path)] == [item.scene for item in found]


def test_files_are_taken_relative_to_the_batch_file_and_seeds_are_not(tmp_path: Path) -> None:
    for name in ("here", "there"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "room.xml").write_text("<scene/>")
    found = [expand(matrix(scenes=["room.xml"], variations=[COLOURS]), tmp_path / name) for name in ("here", "there")]
    assert found[0][0].scene.startswith(str(tmp_path / "here" / "room.xml#"))
    assert [item.variation for item in found[0]] == [item.variation for item in found[1]]


def test_derived_seeds_differ_in_everything_they_derive_from() -> None:
    seeds = {derived_seed(*case) for case in ((0, "a", "v", 0), (1, "a", "v", 0), (0, "b", "v", 0), (0, "a", "w", 0),
                                              (0, "a", "v", 1))}  # fmt: skip
    assert len(seeds) == 5


@pytest.mark.parametrize(("text", "said"), [
    ("scenes: [", "readable YAML"), ("[]", "must be valid"), ("scenes: []", "scenes must be valid"),
    ("scenes: [tiny]\ncolour: 1", "colour must be valid"), ("scenes: [tiny]\npresets: [none]", "preset must be one of"),
    ("scenes: [tiny]\nstages: [paint]", "stages.0"), ("scenes: [tiny]\ninput_spp: [0]", "input_spp.0"),
    ("scenes: [tiny]\nsettings: {frames.colour: 1}", "setting"), ("scenes: [tiny, tiny]", "'tiny' twice"),
    ("scenes: [tiny]\npresets: [draft, {name: draft}]", "'draft' twice"),
    ("scenes: [tiny]\nvariations: [{name: a, materials: 2}]", "materials must lie in"),
    ("scenes: [tiny]\nvariations: [{name: a, count: 2}]", "must change something"),
    ("scenes: [tiny]\nvariations: [{name: A_b, count: 2}]", "variations.0.name"),
    ("scenes: [a, b, c, d, e, f, g, h, i, j, k]\nvariations: [{name: a, count: 10000, light: 2}]", "at most 100000"),
])  # fmt: skip
def test_broken_batches_are_refused_with_a_reason(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "batch.yaml"
    path.write_text(text)
    with pytest.raises(WorkerError, match=said):
        read_matrix(path)


def test_missing_batch_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BatchError, match="No such file"):
        read_matrix(tmp_path / "none.yaml")


def test_plan_renders_nothing_and_run_only_what_is_missing(store: Store) -> None:
    batch = items(variations=[{"name": "original"}, COLOURS])
    rows = plan_batch(batch, store, Progress())
    assert [row["num_missing"] for row in rows] == [8, 8, 8]
    assert rows[0]["paths"] == (3 * (1 + 4) + 1 * (1 + 8)) * 16 * 16
    assert len({row["digest"] for row in rows}) == 3
    assert store.scenes() == []
    results = run_batch(batch, store, Progress())
    assert [(result.num_rendered, result.error) for result in results] == [(8, None)] * 3
    assert [row["num_missing"] for row in plan_batch(batch, store, Progress())] == [0, 0, 0]
    assert [result.num_rendered for result in run_batch(batch, store, Progress())] == [0, 0, 0]
    entry = store.find_scene(rows[1]["scene"])
    assert load_scene(entry["source"]).digest == rows[1]["digest"], "a variant can be loaded from what the store says"
    assert entry["variation"]["changes"]


def test_failed_combination_is_told_and_the_batch_goes_on(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    batch = items(scenes=["none.xml", "tiny"])
    results = run_batch(batch, store, Progress())
    assert "none.xml" in (results[0].error or "") and results[0].num_rendered == 0
    assert results[1].error is None and results[1].num_rendered == 8


def test_failure_within_a_combination_keeps_what_was_rendered(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(run: RunState, elements: object) -> None:
        raise WorkerError("bake must work, got none")

    monkeypatch.setattr(batch_module, "run_bake", fail)
    (result,) = run_batch(items(stages=["bake"]), store, Progress())
    assert result.error == "bake must work, got none" and result.num_rendered == 8


def test_presets_of_a_variant_load_it_once(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    loads = []
    monkeypatch.setattr(
        batch_module, "load_scene", lambda source, **size: loads.append(source) or load_scene(source, **size)
    )
    presets = ["tiny", {"name": "tiny", "label": "more", "settings": {"frames.num_train": 3}}]
    run_batch(items(presets=presets, variations=[COLOURS]), store, Progress())
    assert len(loads) == 2


@pytest.mark.parametrize("input_spp", [(4,), (3, 4), (1, 9)])
def test_inputs_that_reach_the_reference_or_each_other_are_refused(store: Store, input_spp: tuple[int, ...]) -> None:
    settings = Settings.preset_named("tiny").override({**SMALL, "width": 16, "height": 16, "frames.test_spp": 4})
    run = RunState(load_scene("tiny", width=16, height=16), store, settings)
    assert {unit.spp for unit in frame_units(run, (1, 2))} == {1, 2, 4}
    with pytest.raises(BatchError, match="input_spp must rise"):
        frame_units(run, input_spp)
