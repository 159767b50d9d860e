"""One dataset out of a batch, and the torch Dataset that streams it."""

import json
import multiprocessing
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from storage.datasets import verify_dataset
from storage.errors import DatasetError
from storage.store import Store
from tests.storage.test_datasets import oidn_groups
from workers import dataset as dataset_module
from workers.batch import open_items, run_batch
from workers.batch_matrix import BatchError, BatchItem, Matrix, expand
from workers.dataset import write_dataset
from workers.errors import WorkerError
from workers.frame_dataset import FrameDataset, FrameDatasetError
from workers.progress import Progress
from workers.render import load_render
from workers.splits import split_of_scenes

SIZE = 32
MATRIX = {
    "scenes": ["tiny"], "presets": ["tiny"], "resolution": [SIZE, SIZE], "input_spp": [1, 2],
    "settings": {"frames.num_train": 3, "frames.num_test": 2, "frames.train_spp": 4, "frames.test_spp": 8},
    "variations": [{"name": "original"}, {"name": "colours", "materials": 0.7, "light": [0.5, 2.0], "camera": 0.1}],
}  # fmt: skip


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Store, list[BatchItem]]:
    """A store with the frames of a small batch."""
    store = Store.open(tmp_path_factory.mktemp("store"), create=True)
    batch = expand(Matrix.model_validate(MATRIX), Path("."))
    assert all(result.error is None for result in run_batch(batch, store, Progress()))
    return store, batch


@pytest.fixture(scope="module")
def folder(rendered: tuple[Store, list[BatchItem]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("dataset")
    write(rendered, path)
    return path


def write(rendered: tuple[Store, list[BatchItem]], path: Path, **options: Any) -> dict[str, Any]:
    store, batch = rendered
    arguments = {"split_by": "path", "bases": [item.base for item in batch], **options}
    return write_dataset(open_items(batch, store, Progress()), str(path), **arguments)


def manifest_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "manifest.json").read_text())


def test_every_image_tells_where_it_comes_from(rendered: tuple[Store, list[BatchItem]], folder: Path) -> None:
    store, batch = rendered
    manifest = manifest_of(folder)
    runs = {run.scene.digest: run for _, run in open_items(batch, store, Progress())}
    assert {scene["digest"] for scene in manifest["scenes"]} == set(runs)
    assert manifest["scenes"][1]["variation"]["changes"] and not manifest["scenes"][0]["variation"]
    keys = {ref.key: ref for digest in runs for ref in store.units(digest, "render")}
    for frame in manifest["frames"]:
        for image in frame["images"]:
            record = store.committed(keys.pop(image["unit_key"]))
            assert record is not None
            assert (image["seed"], image["spp"], image["health"]) == (record["seed"], record["spp"], record["health"])
            assert record["camera"] == frame["camera"]
            assert (image["standard_error"] is None) == (image["spp"] == 1)
    assert keys == {}, "every frame of the store is in the dataset"
    assert (frame["variation"] is None) == (frame["scene"] == manifest["scenes"][0]["digest"])


def test_pixels_are_the_stores(rendered: tuple[Store, list[BatchItem]], folder: Path) -> None:
    store, batch = rendered
    _, run = next(open_items(batch, store, Progress()))
    frame = next(frame for frame in manifest_of(folder)["frames"] if frame["scene"] == run.scene.digest)
    dataset = FrameDataset(folder, "train")
    index = next(i for i in range(len(dataset)) if dataset.provenance(i)["group"] == frame["group"])
    refs = {ref.key: ref for ref in store.units(run.scene.digest, "render")}
    noisy, reference = frame["images"][0], frame["images"][-1]
    sample = dataset[index]
    assert sample["name"] == noisy["name"] and reference["role"] == "reference"
    of_key = {"input": (noisy, "radiance"), "target": (reference, "radiance"), "albedo": (noisy, "albedo"),
              "normal": (noisy, "normal")}  # fmt: skip
    for key, (image, layer) in of_key.items():
        expected = load_render(run, refs[image["unit_key"]])[layer].transpose(2, 0, 1)
        np.testing.assert_array_equal(sample[key].numpy(), expected)


def test_names_are_read_by_open_image_denoise_and_bytes_are_right(folder: Path) -> None:
    manifest = manifest_of(folder)
    assert verify_dataset(folder) == []
    for split in ("train", "valid", "test"):
        groups = oidn_groups(folder / split)
        frames = [frame for frame in manifest["frames"] if frame["split"] == split]
        assert set(groups) == {frame["group"] for frame in frames}
        for frame in frames:
            inputs, target = groups[frame["group"]]
            assert target == f"{frame['group']}_ref"
            assert [image["name"] for image in frame["images"]] == [*inputs, target]
            assert json.loads((folder / split / f"{frame['group']}.json").read_text()) == {
                "exposure": frame["exposure"]
            }


def test_splits_by_path_share_no_pose(folder: Path) -> None:
    manifest = manifest_of(folder)
    assert manifest["splits"] == {"train": 6, "valid": 2, "test": 4}
    poses: dict[str, set[str]] = {split: set() for split in manifest["splits"]}
    for frame in manifest["frames"]:
        poses[frame["split"]].add(json.dumps(frame["camera"]))
        assert (frame["path"] == "B") == (frame["split"] == "test")
    assert not poses["train"] & poses["valid"] and not (poses["train"] | poses["valid"]) & poses["test"]


def test_splits_by_scene_are_disjoint_deterministic_and_need_three() -> None:
    names = [f"scene-{index}" for index in range(20)]
    splits = split_of_scenes(names)
    assert splits == split_of_scenes(names[::-1] + names)
    assert sorted(splits.values()) == ["test"] * 2 + ["train"] * 16 + ["valid"] * 2
    assert sorted(split_of_scenes(names[:3]).values()) == ["test", "train", "valid"]
    with pytest.raises(BatchError, match="at least 3 scenes, got 2"):
        split_of_scenes(["a", "b", "a"])


def test_split_by_scene_decides_the_folder(rendered: tuple[Store, list[BatchItem]], tmp_path: Path) -> None:
    manifest = write(rendered, tmp_path, split_by="scene", bases=["tiny", "b", "c"])
    expected = split_of_scenes(["tiny", "b", "c"])["tiny"]
    assert {frame["split"] for frame in manifest["frames"]} == {expected}
    assert {frame["splits"]["path"] for frame in manifest["frames"]} == {"train", "valid", "test"}


def test_writing_twice_gives_the_same_bytes(
    rendered: tuple[Store, list[BatchItem]], folder: Path, tmp_path: Path
) -> None:
    write(rendered, tmp_path)
    files = sorted(file.relative_to(folder) for file in folder.rglob("*") if file.is_file())
    assert files == sorted(file.relative_to(tmp_path) for file in tmp_path.rglob("*") if file.is_file())
    assert all((folder / file).read_bytes() == (tmp_path / file).read_bytes() for file in files)


def test_frame_that_is_not_rendered_is_refused(rendered: tuple[Store, list[BatchItem]], tmp_path: Path) -> None:
    empty = Store.open(tmp_path / "store", create=True)
    with pytest.raises(BatchError, match="18 of 18 missing"):
        write((empty, rendered[1]), tmp_path / "dataset")


def test_frame_with_nan_is_left_out_and_named(
    rendered: tuple[Store, list[BatchItem]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = {"reference": 0}

    def damaged(run: Any, ref: Any) -> dict[str, np.ndarray]:
        layers = load_render(run, ref)
        spp = (run.store.committed(ref) or {})["spp"]
        if spp == 8 or (spp == 2 and calls["reference"] == 0):
            calls["reference"] += spp == 2
            layers["radiance"][0, 0, 0] = np.nan
        return layers

    monkeypatch.setattr(dataset_module, "load_render", damaged)
    manifest = write(rendered, tmp_path)
    assert manifest["splits"]["test"] == 0
    assert len(manifest["excluded"]) == 5
    assert all("1 NaN" in entry["reason"] and entry["unit_key"] for entry in manifest["excluded"])
    assert {len(frame["images"]) for frame in manifest["frames"]} == {2, 3}


def test_frames_shared_by_presets_enter_once(rendered: tuple[Store, list[BatchItem]], tmp_path: Path) -> None:
    more = {"name": "tiny", "label": "other", "settings": {"cache.diffuse_spp": 128}}
    batch = expand(Matrix.model_validate({**MATRIX, "presets": ["tiny", more]}), Path("."))
    manifest = write((rendered[0], batch), tmp_path)
    assert len(manifest["frames"]) == 12 and len(manifest["scenes"]) == 4


# ------------------------------------------------- torch -------------------------------------------------


def test_dataset_pairs_every_noisy_frame_with_its_reference(folder: Path) -> None:
    dataset = FrameDataset(folder, "train")
    assert len(dataset) == 12 and len(FrameDataset(folder, "test", input_spp=(1,))) == 4
    assert {dataset[index]["name"].rsplit("_")[1] for index in range(12)} == {"000001spp", "000002spp"}
    sample = dataset[-1]
    assert {key: tuple(value.shape) for key, value in sample.items() if key != "name"} == {
        "input": (3, SIZE, SIZE), "target": (3, SIZE, SIZE), "albedo": (3, SIZE, SIZE), "normal": (3, SIZE, SIZE),
        "exposure": (),
    }  # fmt: skip
    assert all(value.dtype == torch.float32 for key, value in sample.items() if key != "name")
    with pytest.raises(IndexError):
        dataset[12]


def test_crops_are_the_same_window_of_every_layer_and_change_with_the_epoch(folder: Path) -> None:
    whole, crops = FrameDataset(folder, "train"), FrameDataset(folder, "train", crop=8)
    first = crops[3]
    starts = [(y, x) for y in range(SIZE - 7) for x in range(SIZE - 7)
              if torch.equal(whole[3]["target"][:, y : y + 8, x : x + 8], first["target"])]  # fmt: skip
    (window,) = starts
    for key in ("input", "albedo", "normal"):
        assert torch.equal(whole[3][key][:, window[0] : window[0] + 8, window[1] : window[1] + 8], first[key])
    assert torch.equal(crops[3]["input"], first["input"])
    crops.set_epoch(1)
    assert not torch.equal(crops[3]["input"], first["input"])


def test_loader_processes_give_the_same_samples_and_see_a_new_epoch(folder: Path) -> None:
    dataset = FrameDataset(folder, "train", crop=8)
    context = multiprocessing.get_context("fork")  # spawning would import torch anew in each
    loader = DataLoader(dataset, batch_size=4, num_workers=2, persistent_workers=True, multiprocessing_context=context)
    for epoch in range(2):
        dataset.set_epoch(epoch)
        batches = list(loader)
        alone = list(DataLoader(dataset, batch_size=4))
        for batch, expected in zip(batches, alone, strict=True):
            assert batch["name"] == expected["name"]
            assert torch.equal(batch["input"], expected["input"])


def test_dataset_reads_lazily_and_survives_pickling(folder: Path) -> None:
    data = pickle.dumps(FrameDataset(folder, "train", crop=8))
    assert len(data) < 200_000
    assert torch.equal(pickle.loads(data)[0]["input"], FrameDataset(folder, "train", crop=8)[0]["input"])


def test_dataset_without_noisy_frames_gives_references(rendered: tuple[Store, list[BatchItem]], tmp_path: Path) -> None:
    batch = expand(Matrix.model_validate({**MATRIX, "input_spp": []}), Path("."))
    write((rendered[0], batch), tmp_path)
    sample = FrameDataset(tmp_path, "valid")[0]
    assert "input" not in sample and sample["name"].endswith("_ref") and sample["albedo"].max() > 0


def test_dataset_refuses_what_it_has_not(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(FrameDatasetError, match="split must be one of"):
        FrameDataset(folder, "dev")  # type: ignore[arg-type]
    with pytest.raises(FrameDatasetError, match="crop must be 1 to 32"):
        FrameDataset(folder, "train", crop=33)
    with pytest.raises(FrameDatasetError, match="input_spp"):
        FrameDataset(folder, "train", input_spp=(7,))
    with pytest.raises(DatasetError, match=r"manifest\.json"):
        FrameDataset(tmp_path, "train")
    with pytest.raises(WorkerError, match="at least one frame"):
        write_dataset(iter([]), str(tmp_path), split_by="path", bases=[])
