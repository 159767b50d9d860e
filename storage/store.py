"""The content-addressed store: units committed whole, resumed by their markers, verified on every read."""

import os
from collections.abc import Mapping
from typing import Any

from storage import layout, markers, quarantine, scenes
from storage.durable import FileTree
from storage.errors import (
    DamagedUnitError,
    MissingUnitError,
    SceneNotFoundError,
    StoreNotFoundError,
    StoreVersionError,
)
from storage.keys import seed_from_key
from storage.layout import UnitRef
from storage.verification import difference, find_problems


class Store:
    """A folder or URL of scenes and their units. Open it with `Store.open`; it may be pickled."""

    def __init__(self, files: FileTree) -> None:
        self.files = files
        self.layout_version = layout.LAYOUT_VERSION

    @classmethod
    def open(cls, url: str | os.PathLike[str], *, create: bool = False) -> "Store":
        """Opens a store.

        Args:
            url: a local folder or any fsspec URL.
            create: make the store where there is none.

        Raises:
            StoreNotFoundError: there is no store at the URL and `create` is false.
            StoreVersionError: the store has another layout than this code.
            StorageError: the store could not be created: no such bucket, access denied, no answer, disk full.
        """
        store = cls(FileTree(url))
        header = store.files.read(layout.STORE_FILE)
        if header is None:
            if not create:
                raise StoreNotFoundError(
                    f"store must be a folder with {layout.STORE_FILE}, got {store.url}, which has none; "
                    "check the path, or open it with create=True"
                )
            store.write_header()
            header = store.files.read(layout.STORE_FILE)
        store._check_version(header)
        return store

    def write_header(self) -> None:
        """Says that here is a store; a header that is there is replaced."""
        self.files.write(layout.STORE_FILE, markers.seal({"layout_version": layout.LAYOUT_VERSION}))

    @property
    def url(self) -> str:
        return self.files.url

    def __repr__(self) -> str:
        return f"Store({self.url!r})"

    # ---------------------------------------------------------------- scenes

    def register_scene(self, digest: str, info: Mapping[str, Any]) -> dict[str, Any]:
        """Records a scene's name and facts; a scene registered before is brought up to date.

        Args:
            digest: digest of the scene's content.
            info: JSON-like facts; `name` defaults to the digest.

        Returns:
            The scene's entry: `digest`, `name` and the facts.
        """
        return scenes.register(self.files, digest, info)

    def scenes(self) -> list[dict[str, Any]]:
        """Lists the registered scenes by name.

        An entry that cannot be read is left out; `verify` and the log name it.
        """
        return scenes.entries(self.files, self.layout_version)

    def find_scene(self, name_or_digest: str) -> dict[str, Any]:
        """Finds a scene by digest, by name or by a digest's first six or more digits.

        Raises:
            SceneNotFoundError: none or several match.
            DamagedUnitError: none matches, and an entry cannot be read that may be the one.
        """
        try:
            return scenes.find(self.scenes(), name_or_digest, self.url)
        except SceneNotFoundError:
            for error in scenes.damaged(self.files, self.layout_version):
                raise error from None
            raise

    # ----------------------------------------------------------------- units

    def commit(self, ref: UnitRef, files: Mapping[str, bytes], record: Mapping[str, Any]) -> dict[str, Any]:
        """Stores a unit whole, marker last. A unit that is already committed is left as it is.

        Args:
            ref: where the unit belongs.
            files: name to content.
            record: facts for the marker (parameters, seconds, health); `seed` defaults to the key's.

        Returns:
            The marker's fields, of the first commit where two processes raced.

        Raises:
            PathNameError: a name cannot be a path segment.
            CanonicalError: the record has no JSON form.
            StoreWriteError: the file system refused; nothing is committed.
            DamagedUnitError: the unit has a marker already, but an unreadable one.
        """
        existing = self.committed(ref)
        if existing is not None:
            return existing
        entries = markers.stored_entries(files, by_content=not self.files.is_local)
        fields = markers.compose(self.own_fields(ref, entries), record)
        stored = {entries[name].get("at", name): data for name, data in files.items()}
        if self.files.publish(ref.folder, {**stored, layout.MARKER: markers.seal(fields)}):
            return fields
        return self._record(ref)

    def committed(self, ref: UnitRef) -> dict[str, Any] | None:
        """Fields of a unit's marker; None where the unit is not committed.

        Raises:
            DamagedUnitError: the marker is there but unreadable.
        """
        return self.read_marker(layout.unit_marker(ref.folder), ref)

    def read(self, ref: UnitRef, name: str) -> bytes:
        """Reads one file of a unit and verifies it.

        Raises:
            MissingUnitError: the unit is not committed, or has no such file.
            DamagedUnitError: the file is gone, or its size or SHA-256 differs from the marker.
        """
        files = self._record(ref)["files"]
        if name not in files:
            raise MissingUnitError(
                f"file must be one of {sorted(files)} in unit {ref} of {self.url}, got {name!r}; check the name"
            )
        path = layout.stored_file(ref.folder, name, files[name])
        data = self.files.read(path)
        problem = difference(data, files[name])
        if data is None or problem:
            raise self.damage(ref, path, problem)
        return data

    def discard(self, ref: UnitRef) -> None:
        """Removes a unit, marker first, so that it is planned again; nothing happens where there is none."""
        self.files.remove_file(layout.unit_marker(ref.folder))
        self.files.remove(ref.folder)

    def units(self, scene_digest: str, stage: str) -> list[UnitRef]:
        """Lists the committed units of a stage by key."""
        keys = self.files.folders_with(layout.stage_folder(scene_digest, stage), layout.MARKER)
        return [UnitRef(scene_digest, stage, key) for key in keys if layout.is_segment(key)]

    def nbytes(self, ref: UnitRef) -> int:
        """Bytes that a unit takes at rest, its markers included; 0 where there is none."""
        return self.files.nbytes(ref.folder)

    # ---------------------------------------------------------------- health

    def verify(self) -> list[str]:
        """Checks every byte that a marker speaks for. Returns one sentence a problem, or an empty list."""
        return [problem.text for problem in find_problems(self)]

    def quarantine(
        self, ref: UnitRef, reason: str, *, cause: quarantine.Cause = "health", unit: int | None = None,
        facts: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:  # fmt: skip
        """Records why a unit was set aside. It stays uncommitted, so the next run computes it again.

        Args:
            ref: the unit, or the cache set of a bake unit.
            reason: one sentence for people.
            cause: "health" (over a limit when it was made) or "damage" (at rest).
            unit: index of the bake unit; None for a whole unit.
            facts: JSON-like: counts, limits.

        Returns:
            The record: address, `unit`, `cause`, `reason`, `facts`, `attempts` (1 at first), `created_unix_s`.
        """
        return quarantine.put(self, ref, reason, cause=cause, unit=unit, facts=facts or {})

    def quarantined(self, scene_digest: str = "") -> list[dict[str, Any]]:
        """Records of the units that were set aside and are not committed since; of all scenes or of one."""
        return quarantine.standing(self, scene_digest)

    # ----------------------------------- for the other modules of this package

    def own_fields(self, ref: UnitRef, files: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
        """What the store itself says in the marker of a unit with these files."""
        return {
            "scene_digest": ref.scene_digest,
            "stage": ref.stage,
            "key": ref.key,
            "seed": seed_from_key(ref.key),
            "files": files,
        }

    def read_marker(self, relative: str, ref: UnitRef) -> dict[str, Any] | None:
        """Reads a marker of a unit; None where there is none.

        Raises:
            DamagedUnitError: it is unreadable or speaks of another unit.
        """
        return self.parse_marker(relative, self.files.read(relative), ref)

    def parse_marker(self, relative: str, data: bytes | None, ref: UnitRef) -> dict[str, Any] | None:
        """Fields of a marker that was read; None where there is none.

        Raises:
            DamagedUnitError: it is unreadable or speaks of another unit.
        """
        if data is None:
            return None
        try:
            fields = markers.unseal(data)
        except ValueError as error:
            raise self.damage(ref, relative, f"is no readable marker: {error}") from error
        if (fields["scene_digest"], fields["stage"], fields["key"]) != (ref.scene_digest, ref.stage, ref.key):
            raise self.damage(ref, relative, f"is the marker of {fields['stage']}/{fields['key']}")
        return fields

    def damage(self, ref: UnitRef, relative: str, problem: str) -> DamagedUnitError:
        """The error for a file that is not what its marker promises."""
        return DamagedUnitError(
            f"unit {ref} in store {self.url} must hold what its marker promises, "
            f"but {self.files.path(relative)} {problem}; run: lightwell verify "
            f"--store {self.url} --repair, then run the scene again"
        )

    def _record(self, ref: UnitRef) -> dict[str, Any]:
        record = self.committed(ref)
        if record is None:
            raise MissingUnitError(
                f"unit {ref} must be committed in store {self.url}, got no "
                f"{self.files.path(layout.unit_marker(ref.folder))}; run its stage first"
            )
        return record

    def _check_version(self, header: bytes | None) -> None:
        unsealed = scenes.parse(self.files, layout.STORE_FILE, header, min(layout.READABLE_LAYOUTS))
        version = unsealed.get("layout_version")
        if version not in layout.READABLE_LAYOUTS:
            raise StoreVersionError(
                f"store {self.url} must have layout version {layout.LAYOUT_VERSION}, got {version!r}; "
                "open it with the release that wrote it, or start a new store"
            )
        if version >= 2:
            scenes.parse(self.files, layout.STORE_FILE, header, version)
        self.layout_version = version
