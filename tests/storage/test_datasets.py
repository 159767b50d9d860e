"""Datasets at rest: names that Open Image Denoise's tools group as meant, verified bytes, repeated writing."""

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from storage.dataset_layout import feature_file, group_name, image_name
from storage.datasets import (
    DatasetWriter,
    decode_image,
    encode_image,
    open_dataset,
    read_feature,
    verify_dataset,
)
from storage.errors import DatasetError, PathNameError


def pixels(value: float = 1.5, height: int = 4, width: int = 6) -> np.ndarray:
    ramp = np.arange(height * width * 3, dtype=np.float32).reshape(height, width, 3)
    return ramp * np.float32(value)


def write(folder: Path, *, groups: tuple[str, ...] = ("a-0000", "a-0001"), value: float = 1.5) -> dict[str, Any]:
    writer = DatasetWriter(folder)
    frames = []
    for group in groups:
        images = []
        for spp in (4, 1, 16, None):
            name = image_name(group, spp)
            files = writer.add_image("train", name, {"hdr": pixels(value), "alb": pixels(0.01), "nrm": pixels(-0.01)})
            images.append({"name": name, "files": files})
        writer.add_exposure("train", group, 0.5)
        frames.append({"group": group, "images": images})
    return writer.finish({"frames": frames})


def oidn_groups(folder: Path) -> dict[str, tuple[list[str], str]]:
    """Groups by the rule of Open Image Denoise's training tools, as its documentation words it: what differs only in
    a suffix behind the last "_" (digits, digits and "spp", or a word for the reference) is one group; sorted by name,
    the last is the target."""
    names = defaultdict(set)
    for file in folder.rglob("*.*.exr"):
        name = file.name.rsplit(".", 2)[0]
        prefix, _, suffix = name.rpartition("_")
        counts = suffix.isdecimal() or (suffix.endswith("spp") and suffix[:-3].isdecimal())
        is_variant = bool(prefix) and (counts or suffix in ("ref", "reference", "gt", "target"))
        names[prefix if is_variant else name].add(name)
    return {group: (sorted(found)[:-1], sorted(found)[-1]) for group, found in names.items()}


def test_names_are_grouped_by_open_image_denoise_as_meant(tmp_path: Path) -> None:
    write(tmp_path)
    for group in ("a-0000", "a-0001"):
        inputs, target = oidn_groups(tmp_path / "train")[group]
        assert inputs == [f"{group}_000001spp", f"{group}_000004spp", f"{group}_000016spp"]
        assert target == f"{group}_ref"
    assert (tmp_path / "train" / "a-0000.json").read_text() == '{"exposure": 0.5}'


@pytest.mark.parametrize("parts", [("a_b",), ("a.b",), ("A",), ("",), ("-a",), ("a" * 161,), ("../a",)])
def test_group_names_that_would_be_misread_are_refused(parts: tuple[str, ...]) -> None:
    with pytest.raises(PathNameError, match="frame group"):
        group_name(*parts)


@pytest.mark.parametrize("call", [
    lambda: image_name("a", 0), lambda: image_name("a", 10**6), lambda: feature_file("dev", "a", "hdr"),
    lambda: feature_file("train", "a", "x"),
])  # fmt: skip
def test_unknown_parts_of_a_name_are_refused(call: Any) -> None:
    with pytest.raises(PathNameError):
        call()


def test_image_round_trips_and_has_plain_channels(tmp_path: Path) -> None:
    image = pixels()
    (tmp_path / "a.exr").write_bytes(encode_image(image))
    np.testing.assert_array_equal(decode_image((tmp_path / "a.exr").read_bytes()), image)
    (part,) = OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True).parts
    assert set(part.channels) == {"R", "G", "B"}
    np.testing.assert_allclose(decode_image(encode_image(image, half=True)), image, rtol=1e-3)
    with pytest.raises(DatasetError, match="float32"):
        encode_image(image.astype(np.float64))
    with pytest.raises(DatasetError, match="RGB EXR"):
        decode_image(b"no image")


def test_writing_again_replaces_only_what_differs(tmp_path: Path) -> None:
    first = write(tmp_path)
    before = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.hdr.exr")}
    assert write(tmp_path) == first
    assert {file: file.stat().st_mtime_ns for file in before} == before
    write(tmp_path, groups=("a-0001",))
    assert not list(tmp_path.rglob("a-0000_*")), "frames that are gone from the manifest are gone from the folder"
    write(tmp_path, value=2.0)
    assert verify_dataset(tmp_path) == []


def test_folder_of_somebody_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(DatasetError, match="must be empty or hold a dataset"):
        DatasetWriter(tmp_path)
    (tmp_path / "manifest.json").write_text('{"format": "other", "version": 1}')
    with pytest.raises(DatasetError, match="version 1, got format other"):
        DatasetWriter(tmp_path)


def test_unfinished_dataset_cannot_be_opened_and_can_be_finished(tmp_path: Path) -> None:
    DatasetWriter(tmp_path).add_image("train", "a_ref", {"hdr": pixels()})
    with pytest.raises(DatasetError, match="no such file"):
        open_dataset(tmp_path)
    write(tmp_path)
    assert open_dataset(tmp_path)[1]["frames"]


@pytest.mark.parametrize("damage", ["flip", "truncate", "delete"])
def test_damaged_file_is_named_and_not_read(tmp_path: Path, damage: str) -> None:
    manifest = write(tmp_path)
    entry = manifest["frames"][0]["images"][1]["files"]["hdr"]
    file = tmp_path / entry["path"]
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    if damage == "delete":
        file.unlink()
    else:
        file.write_bytes(bytes(data) if damage == "flip" else bytes(data[:-1]))
    with pytest.raises(DatasetError, match=r"000001spp|000004spp"):
        read_feature(open_dataset(tmp_path)[0], entry)
    (problem,) = verify_dataset(tmp_path)
    assert entry["path"] in problem
    write(tmp_path)
    assert verify_dataset(tmp_path) == []
