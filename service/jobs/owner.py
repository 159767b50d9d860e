"""Who holds a lease: a process, named so that another one can tell whether it still lives."""

import os
import uuid
from pathlib import Path

import psutil

_RECYCLED_S = 2.0  # a process created later than this after the named one is another with the same number


def _machine() -> str:
    """This boot of this machine and, on Linux, this namespace of process numbers (a container has its own)."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot}.{os.readlink('/proc/self/ns/pid').strip('pid:[]')}"
    except OSError:
        return f"{uuid.getnode():x}.{int(psutil.boot_time())}"


def this_owner() -> str:
    """A name for one dispatcher of this process: machine, process number, its start, and a part of its own."""
    process = psutil.Process()
    return f"{_machine()}/{process.pid}/{process.create_time():.2f}/{uuid.uuid4().hex[:8]}"


def is_gone(owner: str) -> bool:
    """Whether the named process ended for certain; False where it is of another machine or container.

    A lease of such a process is taken over at once, so that a restart after a crash does not wait for it to run out.
    """
    parts = owner.split("/")
    if len(parts) != 4 or parts[0] != _machine():
        return False
    try:
        created_s = psutil.Process(int(parts[1])).create_time()
        status = psutil.Process(int(parts[1])).status()
    except (psutil.NoSuchProcess, ValueError):
        return True
    except psutil.Error:
        return False
    return abs(created_s - float(parts[2])) > _RECYCLED_S or status == psutil.STATUS_ZOMBIE
