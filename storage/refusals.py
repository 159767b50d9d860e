"""What a file system says when it refuses, told as one of our errors: which store, which path, the remedy.

A remote store's own errors (botocore's, aiohttp's) are no OSErrors; they are recognised here and nowhere else.
"""

import asyncio
from typing import Any, Literal

from storage.errors import (
    StorageError,
    StoreAccessError,
    StoreNotFoundError,
    StoreReadError,
    StoreUnreachableError,
    StoreWriteError,
)

Doing = Literal["readable", "writable"]

_NO_BUCKET = ("NoSuchBucket", "InvalidBucketName")
_NO_CREDENTIALS = ("NoCredentialsError", "PartialCredentialsError", "CredentialRetrievalError", "TokenRetrievalError")
_LIBRARIES = ("botocore", "aiobotocore", "aiohttp")
# Raised by botocore and aiohttp where there was no answer; both libraries are optional, so they are known by name.
_NO_ANSWER = ("HTTPClientError", "ConnectionError", "ClientConnectionError", "ClientPayloadError", "ServerTimeoutError")


def error_code(error: BaseException) -> str:
    """The code that an S3 server gave ("NoSuchBucket", "412", ...); "" where the error is of another kind."""
    for candidate in (error, error.__cause__):
        response: Any = getattr(candidate, "response", None)
        if isinstance(response, dict):
            return str(response.get("Error", {}).get("Code", ""))
    return ""


def refusal(error: BaseException, url: str, path: str, doing: Doing) -> StorageError | None:
    """Tells a file system's error as ours.

    Args:
        error: what was caught.
        url: of the store.
        path: what was read or written, as the file system names it.
        doing: what was tried.

    Returns:
        The error to raise, or None where `error` is not a file system's.
    """
    if isinstance(error, StorageError):
        return error
    if not isinstance(error, OSError | asyncio.TimeoutError) and not _is_remote(error):
        return None
    told = f"got {type(error).__name__}: {' '.join(str(error).split())}"
    if error_code(error) in _NO_BUCKET:
        return StoreNotFoundError(
            f"bucket of store {url} must exist, {told}; check the URL and the endpoint, or create the bucket first"
        )
    if isinstance(error, PermissionError) or _named(error, _NO_CREDENTIALS):
        return StoreAccessError(f"store {url} must be {doing} at {path}, {told}; {_access_remedy(url)}")
    if isinstance(error, ConnectionError | TimeoutError | asyncio.TimeoutError) or _named(error, _NO_ANSWER):
        return StoreUnreachableError(
            f"store {url} must be reachable, {told}; check the network and the endpoint (AWS_ENDPOINT_URL)"
        )
    if doing == "writable":
        return StoreWriteError(
            f"store {url} must be writable at {path}, {told}; free space or check permissions, then run again"
        )
    return StoreReadError(
        f"store {url} must be readable at {path}, {told}; check the disk or the server, then try again"
    )


def _access_remedy(url: str) -> str:
    if url.startswith(("s3://", "s3a://")):
        return (
            "check AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY or AWS_PROFILE, and that they may get, put, delete and list"
        )
    return "check the permissions of the folder and of the user that runs this"


def _is_remote(error: BaseException) -> bool:
    return _named(error, ("BotoCoreError", "ClientError"))


def _named(error: BaseException, names: tuple[str, ...]) -> bool:
    """Whether the error's class, or one it derives from, is one of botocore's or aiohttp's with such a name."""
    kinds = type(error).__mro__
    return any(kind.__name__ in names and kind.__module__.partition(".")[0] in _LIBRARIES for kind in kinds)
