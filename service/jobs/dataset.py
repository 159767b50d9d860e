"""A finished job's frames as one zip: a dataset as `lightwell dataset` writes it, without noisy inputs."""

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from service.apart import run_apart


def pack_dataset(store_url: str, spec: dict[str, Any], archive: Path) -> None:
    """Writes the archive.

    Args:
        store_url: holds the frames.
        spec: of the job (`JobSpec`, JSON).
        archive: the file, ending in .zip.

    Raises:
        WorkerError: the frames are not in the store.
        StorageError: one is damaged.
    """
    from storage.store import Store
    from workers.batch import open_items
    from workers.batch_matrix import BatchItem
    from workers.dataset import write_dataset
    from workers.progress import Progress
    from workers.settings import Settings

    settings, scene = Settings.from_json(spec["settings"]), spec["scene"]
    item = BatchItem(
        label=settings.preset, base=Path(scene).name, scene=scene, preset=settings.preset, preset_name=settings.preset,
        resolution=(settings.width, settings.height), input_spp=(), settings=settings,
    )  # fmt: skip
    with TemporaryDirectory(dir=archive.parent) as folder:
        runs = open_items([item], Store.open(store_url), Progress())
        write_dataset(runs, folder, split_by="path", bases=[item.base])
        shutil.make_archive(str(archive.with_suffix("")), "zip", folder)


def pack_apart(store_url: str, spec: dict[str, Any], archive: Path) -> None:
    """`pack_dataset` in a process of its own."""
    run_apart(pack_dataset, store_url, spec, archive)
