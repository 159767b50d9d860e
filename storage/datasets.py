"""Datasets at rest: a folder of single-image EXR files and the manifest that speaks for every byte of them.

The manifest is written last, so a folder without one is unfinished; files whose bytes are already right are left as
they are, so writing again after a crash, or with more frames, only adds.
"""

import io
import json
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
import OpenEXR

from storage import dataset_layout as layout
from storage.durable import FileTree
from storage.errors import DatasetError
from storage.keys import plain
from storage.markers import sha256_hex

FORMAT, FORMAT_VERSION = "lightwell-dataset", 1
_HALF_FEATURES = ("alb", "nrm")  # bounded; radiance and its error stay float32
_RGB = ("R", "G", "B")


class DatasetWriter:
    """Fills a dataset folder; `finish` makes it a dataset.

    Raises:
        DatasetError: the folder holds something else, on construction.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.files = FileTree(folder)
        old = self._old_manifest()
        self._known: dict[str, str] = {}
        for _, image in iterate_images(old):
            self._known |= {entry["path"]: entry["sha256"] for entry in image["files"].values()}
        self._written: set[str] = {layout.MANIFEST}

    def add_image(self, split: str, image: str, features: Mapping[str, np.ndarray]) -> dict[str, dict[str, Any]]:
        """Writes the features of one image, float32 [height, width, 3] each.

        Returns:
            Feature to its file: path, sha256 and nbytes.
        """
        entries = {}
        for feature, pixels in features.items():
            path = layout.feature_file(split, image, feature)
            entries[feature] = self._put(path, encode_image(pixels, half=feature in _HALF_FEATURES))
        return entries

    def add_exposure(self, split: str, group: str, exposure: float) -> None:
        """Writes a group's metadata for Open Image Denoise's tools."""
        self._put(layout.exposure_file(split, group), json.dumps({"exposure": exposure}).encode())

    def finish(self, manifest: Mapping[str, Any]) -> dict[str, Any]:
        """Writes the manifest and removes the files of an older one that it does not name; returns what was written."""
        content = {"format": FORMAT, "version": FORMAT_VERSION, **plain(dict(manifest), "manifest")}
        self.files.write(layout.MANIFEST, (json.dumps(content, indent=1) + "\n").encode())
        for path in sorted(set(self._known) - self._written):
            self.files.remove(path)
        return content

    def _put(self, path: str, data: bytes) -> dict[str, Any]:
        digest = sha256_hex(data)
        self._written.add(path)
        current = self.files.read(path) if self._known.get(path) == digest else None
        if current is None or sha256_hex(current) != digest:
            self.files.write(path, data)
        return {"path": path, "sha256": digest, "nbytes": len(data)}

    def _old_manifest(self) -> dict[str, Any]:
        names = [name for name in self.files.names("") if not name.startswith(".")]
        if layout.MANIFEST in names:
            return read_manifest(self.files)
        if set(names) - set(layout.SPLITS):
            raise DatasetError(
                f"dataset folder must be empty or hold a dataset, got {self.files.url} with {names[0]}; choose another"
            )
        return {}


def open_dataset(folder: str | os.PathLike[str]) -> tuple[FileTree, dict[str, Any]]:
    """A dataset's files and its manifest.

    Raises:
        DatasetError: there is none, or one of another version.
    """
    files = FileTree(folder)
    return files, read_manifest(files)


def read_manifest(files: FileTree) -> dict[str, Any]:
    """The manifest of a dataset folder.

    Raises:
        DatasetError: it is missing, damaged or of another version.
    """
    data = files.read(layout.MANIFEST)
    try:
        content = json.loads(data or b"")
        if (content["format"], content["version"]) == (FORMAT, FORMAT_VERSION):
            return content
        problem = f"format {content['format']} version {content['version']}"
    except (ValueError, KeyError, TypeError) as error:
        problem = "no such file" if data is None else f"{type(error).__name__}: {error}"
    raise DatasetError(
        f"dataset {files.url} must hold a {layout.MANIFEST} of {FORMAT} version {FORMAT_VERSION}, got {problem}; "
        "write it with `lightwell dataset`"
    )


def read_feature(files: FileTree, entry: Mapping[str, Any]) -> np.ndarray:
    """One feature of an image, float32 [height, width, 3], verified against the manifest.

    Raises:
        DatasetError: the file is gone or its bytes are not the manifest's.
    """
    data = files.read(entry["path"])
    if data is None or sha256_hex(data) != entry["sha256"]:
        problem = "no such file" if data is None else "other bytes"
        raise DatasetError(
            f"file {files.path(entry['path'])} must be what the manifest says, got {problem}; write the dataset again"
        )
    return decode_image(data)


def verify_dataset(folder: str | os.PathLike[str]) -> list[str]:
    """Checks every file that the manifest speaks for; one sentence a problem, or an empty list."""
    files, manifest = open_dataset(folder)
    problems = []
    for _, image in iterate_images(manifest):
        for entry in image["files"].values():
            try:
                read_feature(files, entry)
            except DatasetError as error:
                problems.append(str(error))
    return problems


def iterate_images(manifest: Mapping[str, Any]) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """(frame, image) for every image of a manifest."""
    return [(frame, image) for frame in manifest.get("frames", ()) for image in frame["images"]]


def encode_image(pixels: np.ndarray, *, half: bool = False) -> bytes:
    """A single-part EXR with the channels R, G and B.

    Args:
        pixels: float32 [height, width, 3]; row 0 on top.
        half: store 16 bits a channel.

    Raises:
        DatasetError: another shape or dtype.
    """
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.dtype != np.float32 or 0 in pixels.shape:
        raise DatasetError(f"image must be float32 (height, width, 3), got {pixels.dtype} {pixels.shape}")
    stored = pixels.astype(np.float16) if half else pixels
    planes = {name: np.ascontiguousarray(stored[..., index]) for index, name in enumerate(_RGB)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    stream = io.BytesIO()
    OpenEXR.File(header, planes, num_threads=0).write(stream)
    return stream.getvalue()


def decode_image(data: bytes) -> np.ndarray:
    """Inverse of `encode_image`: float32 [height, width, 3].

    Raises:
        DatasetError: the bytes are no such file.
    """
    try:
        channels = OpenEXR.File(io.BytesIO(data), separate_channels=True, num_threads=0).channels()
        return np.stack([channels[name].pixels.astype(np.float32) for name in _RGB], axis=-1)
    except Exception as error:  # the library raises RuntimeError, ValueError, KeyError, ...
        raise DatasetError(f"image must be an RGB EXR file, got {len(data)} bytes: {error}") from error
