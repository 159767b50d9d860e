"""Runs `sample_store.make` in forked children, one for each point at which something may go wrong, and says what
came of it. A process of its own: a child must fork before any thread runs, and an audit hook cannot be taken back.

    python fault_driver.py MODE FOLDER STEP

MODE is crash (the process dies at the k-th change of the disk), torn (it dies at the k-th flush and half of the
file is lost), full (from the k-th change on the disk is full), fsize (RLIMIT_FSIZE of 2**k bytes), denied (a user
who may only read). STEP takes every STEP-th point. Prints one JSON object a point, the last one without fault.
"""

import errno
import json
import os
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from storage.errors import StorageError
from storage.store import Store
from storage.verification import find_problems, repair
from tests.storage import sample_store

CHANGES = ("open", "os.rename", "os.mkdir", "os.remove", "os.rmdir")
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT
NOBODY = 65534
CRASHED, REFUSED = 137, 3


class Fault:
    """Counts the changes below a folder and lets one, or all from one on, go wrong."""

    def __init__(self, mode: str, point: int, folder: str) -> None:
        self.mode, self.point, self.folder, self.count = mode, point, folder, 0
        fsync = os.fsync

        def faulty_fsync(descriptor: int) -> None:
            self.happen("fsync", lambda: self.tear(descriptor))
            fsync(descriptor)

        os.fsync = faulty_fsync
        sys.addaudithook(self.hook)

    def hook(self, event: str, args: tuple[Any, ...]) -> None:
        if event in CHANGES and str(args[0]).startswith(self.folder) and (event != "open" or args[2] & WRITES):
            self.happen(event, lambda: None)

    def happen(self, event: str, before_death: Callable[[], None]) -> None:
        if self.mode == "torn" and event != "fsync":
            return
        self.count += 1
        if self.mode == "full" and self.count > self.point and event not in ("os.remove", "os.rmdir"):
            raise OSError(errno.ENOSPC, "No space left on device")
        if self.mode in ("crash", "torn") and self.count == self.point + 1:
            before_death()
            os._exit(CRASHED)

    def tear(self, descriptor: int) -> None:
        path = f"/proc/self/fd/{descriptor}"
        if self.mode == "torn" and os.path.isfile(path):
            os.truncate(path, os.path.getsize(path) // 2)


def in_child(work: Callable[[], Any]) -> tuple[int, Any]:
    """Exit code and JSON-like result of a piece of work in a forked process."""
    reader, writer = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(reader)
        try:
            result, code = work(), 0
        except StorageError as error:
            result, code = str(error), REFUSED
        except BaseException as error:
            result, code = repr(error), 1
        with os.fdopen(writer, "w") as pipe:
            json.dump(result, pipe)
        os._exit(code)
    os.close(writer)
    with os.fdopen(reader) as pipe:
        text = pipe.read()
    status = os.waitpid(pid, 0)[1]
    return os.waitstatus_to_exitcode(status), json.loads(text) if text else None


def faulty(mode: str, point: int, url: str) -> None:
    if mode == "fsize":
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (2**point, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
    elif mode == "denied":
        os.setgroups([])
        os.setgid(NOBODY)
        os.setuid(NOBODY)
    else:
        Fault(mode, point, url)
    sample_store.make(url)


def inspect(url: str) -> dict[str, Any]:
    """What a reader gets of the store as it is, and what the next run makes of it."""
    truth, wrong = sample_store.expected(), []
    found: list[str] = []
    if Path(url, "store.json").exists():
        store = Store.open(url)
        for name, ask in sample_store.reads(store).items():
            try:
                if ask() != truth[name]:
                    wrong.append(name)
            except StorageError:
                pass  # refused or not there: both are right
        found = [problem.text for problem in find_problems(store)]
    store = sample_store.make(url)
    redone = sample_store.answers(store)
    wrong += [f"{name} after the next run" for name in truth if redone[name] != truth[name]]
    for problem in find_problems(store):
        repair(store, problem)
    return {"wrong": wrong, "found": found, "left": store.verify(), "content": sample_store.content(store)}


def main(mode: str, folder: str, step: int) -> None:
    for point in range(0, 10_000, step):
        url = f"{folder}/{mode}-{point}"
        if mode == "denied":
            os.makedirs(url)
            in_child(lambda url=url: sample_store.make(url) and None)
            os.remove(f"{url}/{sample_store.places(Store.open(url))['marker']}")
        code, told = in_child(lambda url=url, point=point: faulty(mode, point, url))
        after, seen = in_child(lambda url=url: inspect(url))
        print(json.dumps({"point": point, "code": code, "told": told, "after": after, "seen": seen}), flush=True)
        if code not in (CRASHED, REFUSED) or mode == "denied":
            return


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
