"""`lightwell verify`: what is wrong with a store, and taking it away so that the next run puts it right."""

from typing import TYPE_CHECKING, Annotated

import typer

from service.failures import reported

if TYPE_CHECKING:
    from storage.store import Store

EXIT_PROBLEMS = 1


def verify(
    store: Annotated[str, typer.Option("--store", help="folder or URL of the store")],
    repair: Annotated[
        bool,
        typer.Option("--repair", help="discard what is damaged, leaving a record of why; nothing else may be running"),
    ] = False,
) -> None:
    """Read every file of a store and list what is damaged, lost or left over. Exit code 1 where something is."""
    with reported():
        num_problems, num_repaired = _check(store, repair)
        left = num_problems - num_repaired
        if num_repaired:
            print(f"{num_repaired} repaired: run the scenes again to make what was discarded")
        if left:
            print(f"{left} to put right" + ("" if repair else f"; run: lightwell verify --store {store} --repair"))
            raise typer.Exit(EXIT_PROBLEMS)
        print(f"{store}: every file is what its marker promises")


def _check(url: str, repair: bool) -> tuple[int, int]:
    """Prints one line a problem; returns how many there were and how many were repaired."""
    from service.progress import RichProgress
    from storage.verification import find_problems
    from storage.verification import repair as repair_problem

    store, header_problem = _open(url)
    num_problems = num_repaired = 0
    if header_problem:
        print(header_problem)
        num_problems += 1
        if repair:
            store.write_header()
            num_repaired += 1
    with RichProgress() as progress, progress.busy("read every file"):
        for problem in find_problems(store):
            print(problem.text)
            num_problems += 1
            num_repaired += repair and repair_problem(store, problem)
    for record in store.quarantined():
        unit = "" if record["unit"] is None else f" unit {record['unit']}"
        print(f"set aside, {record['attempts']}x ({record['cause']}): {record['stage']}/{record['key']}{unit}: "
              f"{record['reason']}")  # fmt: skip
    return num_problems, num_repaired


def _open(url: str) -> tuple["Store", str]:
    """The store, and what is wrong with its header: a store whose header is lost still has its units."""
    from storage import layout
    from storage.durable import FileTree
    from storage.errors import DamagedUnitError, StoreNotFoundError
    from storage.store import Store

    try:
        return Store.open(url), ""
    except (DamagedUnitError, StoreNotFoundError) as error:
        store = Store(FileTree(url))
        if not store.files.names(layout.SCENES):
            raise
        return store, str(error)
