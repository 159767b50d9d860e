"""A user's mistake is one line on standard error and exit code 2, never a traceback."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import typer

from service.errors import ServiceError

EXIT_MISTAKE = 2
EXIT_INTERRUPTED = 130


def one_line(error: BaseException) -> str:
    """The error's message on one line, with the file's name where the system names one."""
    if isinstance(error, MemoryError):
        detail = " ".join(str(error).split())
        return f"not enough memory{': ' + detail if detail else ''}; choose a smaller size or a smaller preset"
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split()) or type(error).__name__


def known_errors() -> tuple[type[BaseException], ...]:
    """What the packages raise on purpose, and what the system raises for a user's files and memory."""
    from models.errors import ModelError
    from storage.errors import StorageError
    from workers.errors import WorkerError

    return ServiceError, WorkerError, StorageError, ModelError, OSError, MemoryError


@contextmanager
def reported() -> Iterator[None]:
    """Turns known errors into one line and exit code 2, and an interrupt into 130. A bug keeps its traceback.

    Raises:
        typer.Exit: in place of a known error.
    """
    try:
        yield
    except KeyboardInterrupt:
        print(
            "lightwell: interrupted; what was committed is kept, the same command goes on from there",
            file=sys.stderr,
        )
        raise typer.Exit(EXIT_INTERRUPTED) from None
    except Exception as error:
        if not isinstance(error, known_errors()):
            raise
        print(f"lightwell: {one_line(error)}", file=sys.stderr)
        raise typer.Exit(EXIT_MISTAKE) from None
