"""Start Mitsuba on a code generator that works: the only place where `mitsuba` and `drjit` are imported
first.

Import both from here, never directly:

    from workers.backend import dr, mi

Dr.Jit compiles on the CPU through LLVM and picks the first libLLVM that the loader finds. Versions 14 to 16
abort the whole process on Mitsuba 3.9 ("Cannot select ... fminimum"), so a library is chosen here, before
Dr.Jit is imported: `DRJIT_LIBLLVM_PATH` if it is set, else the one that `karellen-llvm-core` put into the
environment, else a system LLVM of at least `MIN_LLVM`. `LIGHTWELL_VARIANT` chooses the Mitsuba variant
(`VARIANTS`).
"""

import ctypes.util
import importlib.metadata
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from workers.errors import BackendError

MIN_LLVM = 19
VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")
_LIBRARY_PATTERN = re.compile(r"libLLVM(?:-(\d+))?(?:\.(?:so|dylib))?(?:\.(\d+))?")
_SYSTEM_FOLDERS = ("/usr/lib/llvm-*/lib", "/usr/lib64", "/usr/lib/*-linux-gnu", "/usr/lib", "/usr/local/lib",
                   "/opt/homebrew/opt/llvm/lib")  # fmt: skip


def llvm_version(path: Path) -> int | None:
    """Major LLVM version that the (resolved) file name or folder tells, or None when it tells none."""
    for name in (path.resolve().name, path.name):
        match = _LIBRARY_PATTERN.match(name)
        if match and (match[1] or match[2]):
            return int(match[1] or match[2])
    folder = re.search(r"llvm[-/@](\d+)", str(path.resolve()))
    return int(folder[1]) if folder else None


def _environment_libraries() -> Iterator[Path]:
    """libLLVM files inside this environment, then those that the installed wheel lists."""
    yield from Path(sys.prefix, "lib").glob("libLLVM*.so*")
    try:
        files = importlib.metadata.files("karellen-llvm-core") or []
    except importlib.metadata.PackageNotFoundError:
        return
    for file in files:
        if file.name.startswith("libLLVM") and ".so" in file.name:
            yield Path(str(file.locate())).resolve()


def _system_libraries() -> Iterator[Path]:
    for folder in _SYSTEM_FOLDERS:
        for suffix in ("so*", "dylib"):
            yield from Path("/").glob(f"{folder[1:]}/libLLVM*.{suffix}")


def find_llvm() -> Path | None:
    """The libLLVM to use: newest of the environment, else newest of the system, never below `MIN_LLVM`."""
    for candidates in (_environment_libraries(), _system_libraries()):
        usable = {path.resolve() for path in candidates if path.is_file() and (llvm_version(path) or 0) >= MIN_LLVM}
        if usable:
            return max(usable, key=lambda path: (llvm_version(path) or 0, str(path)))
    return None


def _loadable_llvm() -> str | None:
    """A bare soname that the dynamic loader resolves to a new enough LLVM (folders not listed above)."""
    for version in range(MIN_LLVM + 11, MIN_LLVM - 1, -1):
        name = ctypes.util.find_library(f"LLVM-{version}")
        if name:
            return name
    return None


def select_llvm() -> str:
    """Set `DRJIT_LIBLLVM_PATH` and return it.

    Raises:
        BackendError: no LLVM of at least `MIN_LLVM` is known, or the variable names an older or missing one.
    """
    given = os.environ.get("DRJIT_LIBLLVM_PATH")
    if given:
        version = llvm_version(Path(given))
        if version is not None and version < MIN_LLVM:
            raise BackendError(
                f"DRJIT_LIBLLVM_PATH must name LLVM {MIN_LLVM} or newer, got {given} (LLVM {version}); "
                "unset it and install karellen-llvm-core"
            )
        if os.sep in given and not Path(given).is_file():
            raise BackendError(f"DRJIT_LIBLLVM_PATH must name a file, got {given}; unset it or correct it")
        return given
    found = find_llvm() or _loadable_llvm()
    if found is None:
        raise BackendError(
            f"LLVM must be version {MIN_LLVM} or newer, got none in this environment or system; run "
            "'pip install karellen-llvm-core' (Linux x86-64) or set DRJIT_LIBLLVM_PATH"
        )
    os.environ["DRJIT_LIBLLVM_PATH"] = str(found)
    return str(found)


def _start_variant() -> str:
    """Choose the library and the Mitsuba variant; returns the variant's name."""
    variant = os.environ.get("LIGHTWELL_VARIANT", VARIANTS[0])
    if variant not in VARIANTS:
        raise BackendError(
            f"LIGHTWELL_VARIANT must be one of {', '.join(VARIANTS)}, got {variant!r}; unset it for {VARIANTS[0]}"
        )
    if variant.startswith("llvm"):
        select_llvm()
    import mitsuba

    if variant not in mitsuba.variants():
        raise BackendError(f"LIGHTWELL_VARIANT must be built into this Mitsuba, got {variant}; unset it")
    try:
        mitsuba.set_variant(variant)
    except Exception as error:  # Mitsuba raises bare exceptions
        line = str(error).strip().splitlines()[-1:] or ["no reason given"]
        raise BackendError(f"variant {variant} must start, got: {line[0]}; check its driver or library") from error
    return variant


VARIANT = _start_variant()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

__all__ = ["VARIANT", "dr", "find_llvm", "llvm_version", "mi", "pool_at_rest", "select_llvm",
           "set_num_threads"]  # fmt: skip


def set_num_threads(num_threads: int) -> None:
    """Give Dr.Jit `num_threads` CPU threads in all, the calling one included.

    Torch and OpenMP keep pools of their own: whoever starts a process divides the cores between them once.

    Raises:
        BackendError: fewer than one thread.
    """
    if num_threads < 1:
        raise BackendError(f"num_threads must be at least 1, got {num_threads}")
    dr.set_thread_count(num_threads)


@contextmanager
def pool_at_rest() -> Iterator[None]:
    """Sends Dr.Jit's CPU threads home for the block; what Dr.Jit computes inside runs on the calling thread.

    They spin for about 10 ms after each kernel. On two cores that made a network which runs right after a
    query 1.5 times slower; ending and starting them again takes 0.1 ms.
    """
    num_threads = dr.thread_count()
    dr.sync_thread()
    dr.set_thread_count(0)
    try:
        yield
    finally:
        dr.set_thread_count(num_threads)
