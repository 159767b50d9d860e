"""Reads a whole store, tells what is wrong with it, and takes damaged units away so that they are made again.

One listing of the store (a request a thousand files), then every byte that a marker speaks for.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from storage import layout, markers, quarantine, scenes, tradeoffs
from storage.errors import DamagedUnitError, PathNameError
from storage.layout import UnitRef

if TYPE_CHECKING:
    from storage.store import Store

Sizes = Mapping[str, int]
_CHECKS_AT_ONCE = 4096  # bounds what is held of a stage with a million units


@dataclass(frozen=True)
class Problem:
    """Something wrong in a store.

    Attributes:
        text: one sentence with place and remedy.
        removes: paths whose removal, in this order, lets the next run put it right; empty where only a run can.
        ref: the unit that is damaged; None for leftovers and entries, of which nothing of value is lost.
        unit: index of the bake unit; None for a whole unit or a set's own files.
    """

    text: str
    removes: tuple[str, ...] = ()
    ref: UnitRef | None = None
    unit: int | None = None


@dataclass(frozen=True)
class _Check:
    """A file that a marker speaks for."""

    entry: Mapping[str, Any]
    ref: UnitRef
    unit: int | None
    removes: tuple[str, ...]


def difference(data: bytes | None, entry: Mapping[str, Any]) -> str:
    """Tells how a file differs from what its marker says; "" when it does not.

    Args:
        data: content of the file, None where it is missing.
        entry: `sha256` and `nbytes` of the marker.
    """
    if data is None:
        return "is missing"
    if len(data) != entry["nbytes"]:
        return f"has {len(data)} bytes instead of {entry['nbytes']}"
    if markers.sha256_hex(data) != entry["sha256"]:
        return "differs from its SHA-256"
    return ""


def find_problems(store: "Store") -> Iterator[Problem]:
    """Checks every file that a marker speaks for, and names what no marker speaks for."""
    files = store.files
    for path in files.partials(""):
        text = f"{files.path(path)} is left from an interrupted write; delete it when nothing is running"
        yield Problem(text, (path,))
    for path in quarantine.unreadable(store):
        yield Problem(f"{files.path(path)} is no readable quarantine record; delete it", (path,))
    for digest, stages in _by_folder(files.sizes(layout.SCENES), depth=1).items():
        yield from _scene_problems(store, digest, stages)


def repair(store: "Store", problem: Problem) -> bool:
    """Takes what is wrong away. A damaged unit leaves a quarantine record with the reason.

    Nothing else may be writing: what looks like a leftover may be a unit that is just being stored.

    Returns:
        Whether the next run will put it right; False where there is nothing to take away.
    """
    if problem.ref is not None:
        store.quarantine(problem.ref, problem.text, cause="damage", unit=problem.unit)
    for path in problem.removes:
        store.files.remove(path)
    return bool(problem.removes)


def _by_folder(sizes: Sizes, depth: int) -> dict[str, dict[str, int]]:
    """Groups paths by their segment at a depth; what is hidden, interrupted or no folder of ours is left out."""
    groups: dict[str, dict[str, int]] = {}
    for path, size in sizes.items():
        parts = path.split("/")
        if len(parts) > depth + 1 and layout.is_segment(parts[depth]) and not any(map(layout.is_partial, parts)):
            groups.setdefault(parts[depth], {})[path] = size
    return groups


def _scene_problems(store: "Store", digest: str, sizes: Sizes) -> Iterator[Problem]:
    path = layout.scene_file(digest)
    stages = _by_folder(sizes, depth=2)
    if path in sizes:
        try:
            scenes.parse(store.files, path, store.files.read(path), store.layout_version)
        except DamagedUnitError as error:
            yield Problem(str(error), (path,))
    elif stages:
        yield Problem(f"{store.files.path(path)} is missing: this is no registered scene; run the scene again")
    trade = layout.tradeoff_file(digest)
    if trade in sizes:
        try:
            tradeoffs.parse(store.files, trade, store.files.read(trade))
        except DamagedUnitError as error:
            yield Problem(str(error), (trade,))
    for stage, inside in stages.items():
        units = {UnitRef(digest, stage, key): sizes for key, sizes in _by_folder(inside, depth=3).items()}
        yield from _stage_problems(store, units)


def _stage_problems(store: "Store", units: Mapping[UnitRef, Sizes]) -> Iterator[Problem]:
    """Checks the units of a stage; their markers, then their files, each many at once."""
    owners: dict[str, tuple[UnitRef, int | None]] = {}
    for ref, sizes in units.items():
        marker = layout.unit_marker(ref.folder)
        inside = [path.removeprefix(f"{ref.folder}/") for path in sizes]
        is_cache_set = any(name.startswith((f"{layout.CACHES}/", f"{layout.UNIT_MARKERS}/")) for name in inside)
        if marker in sizes:
            owners[marker] = (ref, None)
        elif not is_cache_set:
            text = f"{store.files.path(ref.folder)} has no commit marker; discard the unit and run its stage again"
            yield Problem(text, (ref.folder,))
        for name in inside:
            folder, _, file = name.rpartition("/")
            index = layout.bake_marker_index(file) if folder == layout.UNIT_MARKERS else None
            if index is not None:
                owners[f"{ref.folder}/{name}"] = (ref, index)
    yield from _marker_problems(store, units, owners)


def _marker_problems(
    store: "Store", units: Mapping[UnitRef, Sizes], owners: Mapping[str, tuple[UnitRef, int | None]]
) -> Iterator[Problem]:
    checks: dict[str, _Check] = {}
    for path, data in store.files.read_each({path: units[owners[path][0]][path] for path in owners}):
        ref, index = owners[path]
        set_marker = layout.unit_marker(ref.folder)
        plain_unit = index is None and not any(name.startswith(f"{ref.folder}/{layout.CACHES}/") for name in units[ref])
        try:
            fields = store.parse_marker(path, data, ref) or {"files": {}}
            stored = {layout.stored_file(ref.folder, name, entry): entry for name, entry in fields["files"].items()}
        except (DamagedUnitError, PathNameError) as error:
            yield Problem(str(error), (path, ref.folder) if plain_unit else (set_marker, path), ref, index)
            continue
        for file, entry in stored.items():
            removes = (set_marker, ref.folder) if plain_unit else (set_marker, path, file)
            checks[file] = _Check(entry, ref, index, removes)
        if plain_unit:
            yield from _strays(store, set(units[ref]) - {path, *stored})
        elif index is None:
            yield from _lost_bake_units(store, ref, int(fields.get("num_units", 0)), units[ref])
        if len(checks) >= _CHECKS_AT_ONCE:
            yield from _file_problems(store, units, checks)
            checks = {}
    yield from _file_problems(store, units, checks)


def _file_problems(store: "Store", units: Mapping[UnitRef, Sizes], checks: Mapping[str, _Check]) -> Iterator[Problem]:
    """Reads what is there; a file that is missing or cut short is told from the listing alone."""
    whole = {path: check.entry["nbytes"] for path, check in checks.items()
             if units[check.ref].get(path) == check.entry["nbytes"]}  # fmt: skip
    for path in checks.keys() - whole.keys():
        size = units[checks[path].ref].get(path)
        wrong = "is missing" if size is None else f"has {size} bytes instead of {checks[path].entry['nbytes']}"
        yield _damage(store, path, checks[path], wrong)
    for path, data in store.files.read_each(whole):
        if wrong := difference(data, checks[path].entry):
            yield _damage(store, path, checks[path], wrong)


def _damage(store: "Store", path: str, check: _Check, wrong: str) -> Problem:
    return Problem(str(store.damage(check.ref, path, wrong)), check.removes, check.ref, check.unit)


def _strays(store: "Store", paths: set[str]) -> Iterator[Problem]:
    for path in sorted(paths):
        if not path.rpartition("/")[2].startswith("."):  # files of others
            text = f"{store.files.path(path)} belongs to no commit; delete it when nothing is running"
            yield Problem(text, (path,))


def _lost_bake_units(store: "Store", ref: UnitRef, num_units: int, sizes: Sizes) -> Iterator[Problem]:
    """A set that says it is whole must hold a marker for every unit."""
    for index in range(num_units):
        path = layout.bake_marker(ref.folder, index)
        if path not in sizes:
            yield Problem(str(store.damage(ref, path, "is missing")), (layout.unit_marker(ref.folder),), ref, index)
