"""What a remote store needs beyond fsspec: opening it by URL, and putting an object only where there is none.

Credentials and the endpoint come from where the client libraries look for them (AWS_ACCESS_KEY_ID, AWS_PROFILE,
AWS_ENDPOINT_URL, ...; FSSPEC_S3_KEY, FSSPEC_S3_ENDPOINT_URL, ... or fsspec's configuration folder), never from
the URL, so that a URL can be logged and pickled.
"""

import errno
from typing import Any

import fsspec.config
from fsspec import AbstractFileSystem
from fsspec.core import url_to_fs
from fsspec.implementations.local import LocalFileSystem

from storage import refusals
from storage.errors import StoreUrlError

_S3 = ("s3", "s3a")
_WITHOUT_FOLDERS = {*_S3, "gs", "gcs", "az", "abfs"}
_S3_OPTIONS = {
    # 1: a read is one GET; s3fs would ask for the size first, to read large objects in parts.
    "max_concurrency": 1,
    # An endpoint that is not there is told within seconds; s3fs repeats throttled requests itself.
    "config_kwargs": {"retries": {"mode": "standard", "max_attempts": 3}, "connect_timeout": 5},
}
_EXTRAS = {"s3": "lightwell[s3]", "s3a": "lightwell[s3]"}
_MAX_CONFLICTS = 8


def open_filesystem(url: str) -> tuple[AbstractFileSystem, str]:
    """The file system of a URL and the store's root in it, without a slash at its end.

    Raises:
        StoreUrlError: the URL names no bucket or no known protocol, or needs a package that is not installed.
        StorageError: the file system cannot be reached with these settings.
    """
    protocol = url.partition("://")[0].lower() if "://" in url else ""
    options: dict[str, Any] = {"use_listings_cache": False}  # other processes write too
    if protocol in _S3:
        options |= {key: value for key, value in _S3_OPTIONS.items() if key not in fsspec.config.conf.get("s3", {})}
    try:
        filesystem, root = url_to_fs(url, **options)
    except ImportError as error:
        package = _EXTRAS.get(protocol, "it")
        raise StoreUrlError(f"store {url} must have its package installed, got: {error}; install {package}") from error
    except ValueError as error:
        raise StoreUrlError(
            f"store must be a folder or a URL such as s3://bucket/prefix, got {url!r}: {error}; correct it"
        ) from error
    except Exception as error:
        if refused := refusals.refusal(error, url, url, "readable"):
            raise refused from error
        raise
    root = root.rstrip("/")
    if protocol in _S3 and not root:
        raise StoreUrlError(f"store must name a bucket, as in s3://bucket/prefix, got {url!r}; add it")
    return filesystem, root


def is_local(filesystem: AbstractFileSystem) -> bool:
    return isinstance(filesystem, LocalFileSystem)


def has_folders(filesystem: AbstractFileSystem) -> bool:
    """Whether a folder must be made before a file is put into it. In an object store that would make the bucket."""
    protocol = filesystem.protocol
    return not _WITHOUT_FOLDERS & set([protocol] if isinstance(protocol, str) else protocol)


def put_new(filesystem: AbstractFileSystem, path: str, data: bytes) -> bool:
    """Puts an object where there is none (S3: If-None-Match).

    Where the server or fsspec's file system knows no such condition, presence is tested first, which is not
    atomic: of two writers in the same instant the later one stays.

    Returns:
        Whether it was put; False where one was there.

    Raises:
        Exception: whatever the file system says of a failed write.
    """
    for attempt in range(_MAX_CONFLICTS):
        try:
            filesystem.pipe_file(path, data, mode="create")
            return True
        except FileExistsError:
            return False
        except OSError as error:
            code = refusals.error_code(error)
            if code in ("PreconditionFailed", "412"):
                return False
            if code == "NotImplemented" or error.errno == errno.ENOSYS:
                break
            if code not in ("ConditionalRequestConflict", "OperationAborted", "409") or attempt + 1 == _MAX_CONFLICTS:
                raise  # a conflict means that another put of this object has not ended yet
    if filesystem.exists(path):
        return False
    filesystem.pipe_file(path, data)
    return True
