"""Scene bundles on disk: unpacked, judged, and only then given a name that anybody can ask for.

    <folder>/<id>/bundle.json           what was found in it
    <folder>/<id>/<name>/<files>        its files; load_scene names the scene after their folder
    <folder>/.incoming-<random>/        being received; removed when it is refused, swept after a crash

The id is a hash of the name and of every file, so that the same bundle sent twice is one. A bundle is moved into
place by one rename and never changed.
"""

import contextlib
import fcntl
import hashlib
import json
import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from service.bundle_archive import ArchiveLimits, Unpacked, unpack
from service.bundle_rules import BundleFiles, SceneLimits
from service.bundle_scenes import find_scenes
from service.errors import BundleStorageError, UnknownBundleError

_INCOMING = ".incoming-"
_RECORD = "bundle.json"
_ID = re.compile(r"[0-9a-f]{32}")
_MAX_NAME = 64
_MAX_NOTES = 50


@dataclass(frozen=True)
class Bundle:
    """A bundle that was accepted.

    Attributes:
        id: 32 hexadecimal digits.
        name: slug from what the client called it.
        created: Unix time, seconds.
        nbytes: of its files, unpacked.
        num_files: how many.
        scenes: files that can be named as "bundle:<id>/<file>"; the first one is what "bundle:<id>" means.
        notes: what was left out.
    """

    id: str
    name: str
    created: float
    nbytes: int
    num_files: int
    scenes: tuple[str, ...]
    notes: tuple[str, ...]


class BundleStore:
    """The bundles of one folder of a local disk.

    Args:
        folder: where they lie; made when the first one comes.
        archive_limits: what an archive may cost.
        scene_limits: what a scene may ask for.
    """

    def __init__(self, folder: Path, archive_limits: ArchiveLimits, scene_limits: SceneLimits) -> None:
        self.folder, self.archive_limits, self.scene_limits = folder, archive_limits, scene_limits
        self._sweep()

    @contextlib.contextmanager
    def receiving(self) -> Iterator[Path]:
        """A new private folder for one upload; whatever is still in it afterwards is removed.

        Raises:
            BundleStorageError: the disk refuses.
        """
        with _storing():
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            incoming = Path(tempfile.mkdtemp(prefix=_INCOMING, dir=self.folder))
            lock = os.open(incoming, os.O_RDONLY | os.O_DIRECTORY)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX)
                yield incoming
            finally:
                shutil.rmtree(incoming, ignore_errors=True)
                os.close(lock)

    def add(self, incoming: Path, archive: Path, name: str) -> tuple[Bundle, bool]:
        """Unpack, judge and publish an archive that was received.

        Args:
            incoming: the folder that `receiving` gave.
            archive: the zip, in that folder.
            name: what the client calls it.

        Returns:
            The bundle, and whether it is new.

        Raises:
            BundleError: it is refused; the message names the entry and the rule.
            BundleStorageError: the disk refuses.
        """
        with _storing():
            slug = slug_of(name)
            published = incoming / "bundle"
            content = published / slug
            content.mkdir(parents=True)
            unpacked = unpack(archive, content, self.archive_limits)
            archive.unlink()
            found = find_scenes(BundleFiles(content, frozenset(unpacked.files)), self.scene_limits)
            notes = unpacked.notes + found.notes
            if len(notes) > _MAX_NOTES:
                notes = [*notes[:_MAX_NOTES], f"and {len(notes) - _MAX_NOTES} more"]
            bundle = Bundle(
                id=_content_id(slug, content, unpacked),
                name=slug,
                created=round(time.time(), 3),
                nbytes=unpacked.nbytes,
                num_files=len(unpacked.files),
                scenes=tuple(found.scenes),
                notes=tuple(notes),
            )
            return self._publish(published, bundle)

    def all(self) -> list[Bundle]:
        """Every bundle, the newest first."""
        names = [path.name for path in self.folder.iterdir()] if self.folder.is_dir() else []
        bundles = []
        for name in names:
            with contextlib.suppress(UnknownBundleError):
                bundles.append(self.get(name))
        return sorted(bundles, key=lambda bundle: (-bundle.created, bundle.id))

    def get(self, bundle_id: str) -> Bundle:
        """The bundle with this id.

        Raises:
            UnknownBundleError: there is none.
        """
        try:
            if not _ID.fullmatch(bundle_id):
                raise FileNotFoundError
            record = json.loads((self.folder / bundle_id / _RECORD).read_bytes())
            scenes, notes = tuple(record.pop("scenes")), tuple(record.pop("notes"))
            return Bundle(**record, scenes=scenes, notes=notes)
        except (FileNotFoundError, NotADirectoryError, ValueError, KeyError, TypeError):
            raise UnknownBundleError(
                f"bundle must be one that was uploaded, got {bundle_id[:64]!r}; POST /v1/bundles adds one"
            ) from None

    def scene_file(self, bundle_id: str, scene: str = "") -> Path:
        """The path of one of a bundle's scenes; of the first one where none is named.

        Raises:
            UnknownBundleError: there is no such bundle, or it has no such scene.
        """
        bundle = self.get(bundle_id)
        chosen = scene or bundle.scenes[0]
        if chosen not in bundle.scenes:
            raise UnknownBundleError(
                f"scene must be one of bundle {bundle_id} ({', '.join(bundle.scenes[:10])}), got {scene[:200]!r}"
            )
        return (self.folder / bundle_id / bundle.name / chosen).resolve()

    def delete(self, bundle_id: str) -> None:
        """Removes a bundle: from its name at once, then from the disk.

        Raises:
            UnknownBundleError: there is none.
            BundleStorageError: the disk refuses.
        """
        self.get(bundle_id)
        with self.receiving() as trash:
            try:
                os.rename(self.folder / bundle_id, trash / bundle_id)
            except FileNotFoundError:
                raise UnknownBundleError(f"bundle must be one that was uploaded, got {bundle_id!r}") from None

    def _publish(self, published: Path, bundle: Bundle) -> tuple[Bundle, bool]:
        record = published / _RECORD
        with record.open("w") as file:
            json.dump(asdict(bundle), file, indent=1)
            file.flush()
            os.fsync(file.fileno())
        for folder, _, _ in os.walk(published):
            _sync_folder(Path(folder))
        try:
            os.rename(published, self.folder / bundle.id)
        except OSError:
            if not (self.folder / bundle.id / _RECORD).is_file():
                raise
            return self.get(bundle.id), False
        _sync_folder(self.folder)
        return bundle, True

    def _sweep(self) -> None:
        """Removes what a crash left: folders that no living process has locked."""
        for incoming in self.folder.glob(f"{_INCOMING}*") if self.folder.is_dir() else ():
            with contextlib.suppress(OSError):
                lock = os.open(incoming, os.O_RDONLY | os.O_DIRECTORY)
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    shutil.rmtree(incoming, ignore_errors=True)
                finally:
                    os.close(lock)


def slug_of(name: str) -> str:
    """Letters, digits and hyphens of a file's name without its suffix; "bundle" where nothing is left."""
    stem = re.split(r"[/\\]", name)[-1]
    stem = stem[:-4] if stem.lower().endswith(".zip") else stem
    return re.sub(r"[^a-z0-9]+", "-", stem.lower()).strip("-")[:_MAX_NAME].strip("-") or "bundle"


def _content_id(name: str, folder: Path, unpacked: Unpacked) -> str:
    digest = hashlib.sha256(json.dumps(name).encode())
    for relative in unpacked.files:
        with (folder / relative).open("rb") as file:
            content = hashlib.file_digest(file, "sha256").hexdigest()
        digest.update(json.dumps([relative, content]).encode())
    return digest.hexdigest()[:32]


@contextlib.contextmanager
def _storing() -> Iterator[None]:
    """Turns what the disk says into an error of ours, without the folder's path."""
    try:
        yield
    except BundleStorageError:
        raise
    except OSError as error:
        raise BundleStorageError(f"bundle must fit on the service's disk, got: {error.strerror or error}") from error


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
