"""The content-addressed store: units committed whole, resumed by their markers, verified on every read."""

import json
import os
from collections.abc import Mapping
from typing import Any

from storage import layout, markers
from storage.durable import FileTree
from storage.errors import (
    DamagedUnitError,
    MissingUnitError,
    SceneNotFoundError,
    StoreNotFoundError,
    StoreVersionError,
)
from storage.keys import plain, seed_from_key
from storage.layout import UnitRef
from storage.verification import difference, verify_store


class Store:
    """A folder or URL of scenes and their units. Open it with `Store.open`; it may be pickled."""

    def __init__(self, files: FileTree) -> None:
        self.files = files

    @classmethod
    def open(cls, url: str | os.PathLike[str], *, create: bool = False) -> "Store":
        """Opens a store.

        Args:
            url: a local folder or any fsspec URL.
            create: make the store where there is none.

        Raises:
            StoreNotFoundError: there is no store at the URL and `create` is false.
            StoreVersionError: the store has another layout than this code.
            StoreWriteError: the store could not be created.
        """
        store = cls(FileTree(url))
        if not store.files.exists(layout.STORE_FILE):
            if not create:
                raise StoreNotFoundError(
                    f"store must be a folder with {layout.STORE_FILE}, got {store.url}, which has none; "
                    "check the path, or open it with create=True"
                )
            store.files.write(layout.STORE_FILE, _pretty({"layout_version": layout.LAYOUT_VERSION}))
        store._check_version()
        return store

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
        entry = {"name": digest, **plain(dict(info), "info"), "digest": digest}
        self.files.write(layout.scene_file(digest), _pretty(entry))
        return entry

    def scenes(self) -> list[dict[str, Any]]:
        """Lists the registered scenes by name.

        Raises:
            DamagedUnitError: a scene's entry cannot be read.
        """
        digests = filter(layout.is_segment, self.files.names(layout.SCENES))
        files = [layout.scene_file(digest) for digest in digests]
        entries = [self._read_json(file) for file in files if self.files.exists(file)]
        return sorted(entries, key=lambda entry: (str(entry["name"]), entry["digest"]))

    def find_scene(self, name_or_digest: str) -> dict[str, Any]:
        """Finds a scene by digest, by name or by a digest's first six or more digits.

        Raises:
            SceneNotFoundError: none or several match.
        """
        scenes = self.scenes()
        matches = [scene for scene in scenes if scene["digest"] == name_or_digest]
        matches = matches or [scene for scene in scenes if scene["name"] == name_or_digest]
        if not matches and len(name_or_digest) >= 6:
            matches = [scene for scene in scenes if scene["digest"].startswith(name_or_digest)]
        if len(matches) == 1:
            return matches[0]
        known = ", ".join(f"{scene['name']} ({scene['digest']})" for scene in matches or scenes) or "none"
        raise SceneNotFoundError(
            f"scene must match one in {self.url}, got {name_or_digest!r} with {len(matches)} matches; "
            f"{'tell them apart by digest' if matches else 'known scenes'}: {known}"
        )

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
        entries = {layout.file_name(name): markers.file_entry(data) for name, data in files.items()}
        fields = markers.compose(self.own_fields(ref, entries), record)
        self.files.publish(ref.folder, {**files, layout.MARKER: markers.seal(fields)})
        return self.committed(ref) or fields

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
        data = self.files.read(layout.unit_file(ref.folder, name))
        problem = difference(data, files[name])
        if data is None or problem:
            raise self.damage(ref, f"{ref.folder}/{name}", problem)
        return data

    def discard(self, ref: UnitRef) -> None:
        """Removes a unit, marker first, so that it is planned again; nothing happens where there is none."""
        self.files.remove(layout.unit_marker(ref.folder))
        self.files.remove(ref.folder)

    def units(self, scene_digest: str, stage: str) -> list[UnitRef]:
        """Lists the committed units of a stage by key."""
        keys = self.files.names(layout.stage_folder(scene_digest, stage))
        refs = [UnitRef(scene_digest, stage, key) for key in keys if layout.is_segment(key)]
        return [ref for ref in refs if self.files.exists(layout.unit_marker(ref.folder))]

    def nbytes(self, ref: UnitRef) -> int:
        """Bytes that a unit takes at rest, its markers included; 0 where there is none."""
        return self.files.nbytes(ref.folder)

    def verify(self) -> list[str]:
        """Checks every byte that a marker speaks for. Returns one sentence a problem, or an empty list."""
        return verify_store(self)

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
        data = self.files.read(relative)
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
            f"but {self.files.path(relative)} {problem}; discard the unit "
            "(one bake unit: CacheSet.discard_unit) and run its stage again"
        )

    def _record(self, ref: UnitRef) -> dict[str, Any]:
        record = self.committed(ref)
        if record is None:
            raise MissingUnitError(
                f"unit {ref} must be committed in store {self.url}, got no "
                f"{self.files.path(layout.unit_marker(ref.folder))}; run its stage first"
            )
        return record

    def _read_json(self, relative: str) -> dict[str, Any]:
        try:
            content = json.loads(self.files.read(relative) or b"")
            if isinstance(content, dict):
                return content
            problem = f"a {type(content).__name__}"
        except ValueError as error:
            problem = str(error)
        raise DamagedUnitError(
            f"{self.files.path(relative)} in store {self.url} must hold a JSON object, got {problem}; "
            "remove the file and submit the scene again"
        )

    def _check_version(self) -> None:
        version = self._read_json(layout.STORE_FILE).get("layout_version")
        if version != layout.LAYOUT_VERSION:
            raise StoreVersionError(
                f"store {self.url} must have layout version {layout.LAYOUT_VERSION}, got {version!r}; "
                "open it with the release that wrote it, or start a new store"
            )


def _pretty(content: Mapping[str, Any]) -> bytes:
    return json.dumps(content, indent=1, sort_keys=True, ensure_ascii=False).encode()
