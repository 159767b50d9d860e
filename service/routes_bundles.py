"""Scene bundles over HTTP.

POST   /v1/bundles        a zip, as the body or as the file of a form
GET    /v1/bundles        what was uploaded
GET    /v1/bundles/{id}
DELETE /v1/bundles/{id}
"""

import asyncio
import shutil
from collections.abc import AsyncIterator, Callable
from contextlib import ExitStack, asynccontextmanager
from pathlib import Path
from typing import Annotated, Any

from fastapi import FastAPI, HTTPException, Query, Request, Response
from pydantic import BaseModel, Field
from starlette.datastructures import UploadFile
from starlette.requests import ClientDisconnect

from service.bundles import Bundle, BundleStore
from service.errors import BundleInUseError, BundleStorageError, BundleTooLargeError, UnsupportedUploadError
from service.problems import PROBLEM

UPLOAD_PATH = "/v1/bundles"
FORM_OVERHEAD_NBYTES = 64 << 10  # boundaries and part headers around the file
ZIP_TYPES = ("application/zip", "application/x-zip-compressed", "application/octet-stream")
MAX_UNPACKING = 2
_FORM = "multipart/form-data"
_BINARY = {"type": "string", "format": "binary"}
_BODY = {
    "requestBody": {
        "required": True,
        "content": {
            "application/zip": {"schema": _BINARY},
            _FORM: {"schema": {"type": "object", "required": ["file"], "properties": {"file": _BINARY}}},
        },
    }
}


class BundleScene(BaseModel):
    """A scene of a bundle."""

    file: str = Field(description="its path in the bundle", examples=["scene.xml"])
    source: str = Field(description="what a job takes as its scene", examples=["bundle:0123abcd.../scene.xml"])


class BundleShown(BaseModel):
    """A bundle that was accepted."""

    id: str = Field(description="32 hexadecimal digits, from the bundle's content")
    name: str = Field(description="from the uploaded file's name; scenes at the root are named after it")
    source: str = Field(description="what a job takes as its scene: the bundle's first scene")
    created: float = Field(description="Unix time, seconds")
    nbytes: int = Field(description="of its files, unpacked")
    num_files: int
    scenes: list[BundleScene]
    notes: list[str] = Field(description="what was left out, and why")


class BundleList(BaseModel):
    """The newest first."""

    bundles: list[BundleShown]


def _shown(bundle: Bundle) -> BundleShown:
    source = f"bundle:{bundle.id}"
    return BundleShown(
        id=bundle.id,
        name=bundle.name,
        source=source,
        created=bundle.created,
        nbytes=bundle.nbytes,
        num_files=bundle.num_files,
        scenes=[BundleScene(file=scene, source=f"{source}/{scene}") for scene in bundle.scenes],
        notes=list(bundle.notes),
    )


def _problems(**descriptions: str) -> dict[int | str, dict[str, Any]]:
    schema = {"schema": {"type": "object"}}
    return {
        int(status[1:]): {"description": description, "content": {PROBLEM: schema}}
        for status, description in descriptions.items()
    }


def add_bundle_routes(
    app: FastAPI,
    store: BundleStore,
    max_upload_nbytes: int,
    in_use: Callable[[str], bool] = lambda bundle_id: False,
) -> None:
    """Adds the routes.

    Args:
        app: the service.
        store: where bundles lie.
        max_upload_nbytes: largest archive; `service.request_limits` should allow `UPLOAD_PATH` this much and
            `FORM_OVERHEAD_NBYTES`.
        in_use: whether a bundle must not be deleted now.
    """
    unpacking = asyncio.Semaphore(MAX_UNPACKING)

    @app.post(
        UPLOAD_PATH,
        summary="Upload a scene bundle",
        description="A zip with a scene (XML, YAML or mesh) and the files that it names. Nothing of a refused bundle "
        "is kept; the problem names the entry and the rule. The same bundle sent again is the same bundle (200).",
        status_code=201,
        response_model=BundleShown,
        openapi_extra=_BODY,
        responses={
            200: {"description": "the bundle was there already", "model": BundleShown},
            **_problems(_400="not a form", _413="too many bytes or files", _415="neither a zip nor a form",
                        _422="refused: entry and rule say why", _507="the disk is full"),
        },
    )  # fmt: skip
    async def upload(
        request: Request,
        response: Response,
        name: Annotated[str | None, Query(max_length=200, description="instead of the file's name")] = None,
    ) -> BundleShown:
        async with _receiving(store) as incoming:
            archive = incoming / "upload.zip"
            file_name = await _receive(request, archive, max_upload_nbytes)
            async with unpacking:
                bundle, is_new = await asyncio.to_thread(store.add, incoming, archive, name or file_name)
        response.status_code = 201 if is_new else 200
        response.headers["Location"] = f"{UPLOAD_PATH}/{bundle.id}"
        return _shown(bundle)

    @app.get(UPLOAD_PATH, summary="Uploaded bundles")
    async def list_bundles() -> BundleList:
        return BundleList(bundles=[_shown(bundle) for bundle in await asyncio.to_thread(store.all)])

    @app.get(f"{UPLOAD_PATH}/{{bundle_id}}", summary="One bundle", responses=_problems(_404="no such bundle"))
    async def show_bundle(bundle_id: str) -> BundleShown:
        return _shown(await asyncio.to_thread(store.get, bundle_id))

    @app.delete(
        f"{UPLOAD_PATH}/{{bundle_id}}",
        summary="Delete a bundle",
        status_code=204,
        responses=_problems(_404="no such bundle", _409="jobs or served scenes still read it"),
    )
    async def delete_bundle(bundle_id: str) -> None:
        await asyncio.to_thread(store.get, bundle_id)
        if await asyncio.to_thread(in_use, bundle_id):
            raise BundleInUseError(
                f"bundle must not be read by a job or a scene that is served, got {bundle_id}; "
                "cancel its jobs, or remove its scenes from the store first"
            )
        await asyncio.to_thread(store.delete, bundle_id)


@asynccontextmanager
async def _receiving(store: BundleStore) -> AsyncIterator[Path]:
    """`BundleStore.receiving`, whose disk work does not hold up the event loop."""
    stack = ExitStack()
    try:
        yield await asyncio.to_thread(stack.enter_context, store.receiving())
    finally:
        await asyncio.to_thread(stack.close)


async def _receive(request: Request, archive: Path, max_nbytes: int) -> str:
    """Writes the upload to a file; returns the client's name of it.

    Raises:
        BundleTooLargeError: over `max_nbytes`.
        UnsupportedUploadError: no zip and no form.
        BundleStorageError: the disk refuses.
    """
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    try:
        if media_type in ZIP_TYPES:
            await _receive_body(request, archive, max_nbytes)
            return ""
        if media_type == _FORM:
            return await _receive_form(request, archive, max_nbytes)
    except ClientDisconnect:
        raise HTTPException(400, "the client went away before the upload was complete") from None
    except OSError as error:
        raise BundleStorageError(f"upload must fit on the service's disk, got: {error.strerror or error}") from error
    raise UnsupportedUploadError(f"upload must be {ZIP_TYPES[0]} or {_FORM}, got {media_type[:80]!r}")


async def _receive_body(request: Request, archive: Path, max_nbytes: int) -> None:
    received = 0
    with archive.open("xb") as file:
        async for chunk in request.stream():
            received += len(chunk)
            _check_size(received, max_nbytes)
            await asyncio.to_thread(file.write, chunk)


async def _receive_form(request: Request, archive: Path, max_nbytes: int) -> str:
    async with request.form(max_files=1, max_fields=8) as form:
        upload = form.get("file")
        if not isinstance(upload, UploadFile):
            raise UnsupportedUploadError("upload must have a file named 'file' in its form, got none")
        _check_size(upload.size or 0, max_nbytes)
        with archive.open("xb") as file:
            await asyncio.to_thread(shutil.copyfileobj, upload.file, file, 1 << 20)
        return upload.filename or ""


def _check_size(nbytes: int, max_nbytes: int) -> None:
    if nbytes > max_nbytes:
        raise BundleTooLargeError("bundle", f"must be uploaded in at most {max_nbytes} bytes", "more")
