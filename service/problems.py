"""Errors over HTTP: every one is an RFC 9457 problem document (application/problem+json)."""

import logging
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from sqlalchemy.exc import SQLAlchemyError
from starlette.exceptions import HTTPException

from models.errors import ModelError
from service import errors
from service.redaction import redact
from storage.errors import StorageError, StoreUnreachableError
from workers.errors import CameraError, NoOperatingPointsError, SceneError, UnreachableTargetError, WorkerError
from workers.job_spec import JobSpecError
from workers.settings import SettingsError

PROBLEM = "application/problem+json"
CLIENT_GONE = 499
"""Of a request whose client went away; nobody reads it, access logs show it (nginx's number)."""
log = logging.getLogger("lightwell.service")

STATUS_OF_ERROR: dict[type[Exception], int] = {
    errors.UnknownSceneError: 404,
    errors.UnknownJobError: 404,
    NoOperatingPointsError: 404,
    errors.NotAcceptableError: 406,
    errors.AmbiguousSceneError: 409,
    errors.JobStateError: 409,
    errors.NotReadyError: 409,
    errors.FrameTooLargeError: 413,
    errors.IdempotencyError: 422,
    errors.JobRequestError: 422,
    CameraError: 422,
    JobSpecError: 422,
    SceneError: 422,
    SettingsError: 422,
    UnreachableTargetError: 422,
    errors.JobDatabaseError: 503,
    SQLAlchemyError: 503,
    StoreUnreachableError: 503,
    errors.ClientGoneError: CLIENT_GONE,
    errors.NonFiniteFrameError: 500,
    errors.BusyError: 503,
    errors.SceneTooLargeError: 507,
    errors.UnknownBundleError: 404,
    errors.BundleInUseError: 409,
    errors.BundleTooLargeError: 413,
    errors.UnsupportedUploadError: 415,
    errors.BundleError: 422,
    errors.BundleStorageError: 507,
    errors.ServiceError: 500,
    WorkerError: 500,
    StorageError: 500,
    ModelError: 500,
    MemoryError: 503,
}
"""The most derived class that is listed decides."""

RETRY_AFTER_S = 5
PROBLEM_SCHEMA: dict[str, Any] = {
    "type": "object",
    "required": ["title", "status", "detail"],
    "properties": {
        "title": {"type": "string"},
        "status": {"type": "integer"},
        "detail": {"type": "string"},
        "errors": {"type": "array", "items": {"type": "object", "required": ["where", "message"]}},
    },
}


def problem_responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """What a route's `responses` says of these statuses."""
    content = {PROBLEM: {"schema": PROBLEM_SCHEMA}}
    return {status: {"description": HTTPStatus(status).phrase, "content": content} for status in statuses}


def problem(status: int, detail: str, **extra: Any) -> JSONResponse:
    """A problem document; `title` is the status' own phrase, so `type` is about:blank and left out."""
    title = HTTPStatus(status).phrase if status != CLIENT_GONE else "Client Closed Request"
    content = {"title": title, "status": status, "detail": redact(detail), **extra}
    return JSONResponse(content, status_code=status, media_type=PROBLEM)


def _detail(error: Exception) -> str:
    if isinstance(error, SQLAlchemyError):  # its message holds the statement and its values
        return f"the job database does not answer ({type(error).__name__}); ask again later"
    return " ".join(str(error).split())


def _known_error(_: Request, error: Exception) -> JSONResponse:
    """Every 503 says when to ask again; being busy is no failure and fills no log."""
    status = next(STATUS_OF_ERROR[kind] for kind in type(error).__mro__ if kind in STATUS_OF_ERROR)
    detail = _detail(error) or "not enough memory for this frame; choose a smaller size"
    is_busy = isinstance(error, errors.BusyError)
    if status >= 500 and not is_busy:
        log.error("%s: %s", type(error).__name__, detail)
    extra: dict[str, Any] = {"non_finite": error.non_finite} if isinstance(error, errors.NonFiniteFrameError) else {}
    extra |= {"reachable": error.reachable} if isinstance(error, UnreachableTargetError) else {}
    extra |= getattr(error, "members", {})
    response = problem(status, detail, **extra)
    if status == HTTPStatus.SERVICE_UNAVAILABLE:
        wait_s = error.retry_after_s if isinstance(error, errors.BusyError) else RETRY_AFTER_S
        response.headers["Retry-After"] = str(wait_s)
    return response


def _invalid_request(_: Request, error: Exception) -> JSONResponse:
    """The values given are not repeated: they may be NaN, which JSON cannot hold."""
    assert isinstance(error, RequestValidationError)
    reasons = [
        {"where": ".".join(str(part) for part in reason["loc"] if part != "body"), "message": reason["msg"]}
        for reason in error.errors()
    ]
    detail = "; ".join(f"{reason['where'] or 'body'}: {reason['message']}" for reason in reasons)
    return problem(422, detail, errors=reasons)


def _http_error(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    response = problem(error.status_code, str(error.detail))
    response.headers.update(error.headers or {})
    return response


def _unknown_error(_: Request, error: Exception) -> JSONResponse:
    """The traceback goes to the log (starlette raises on); the client learns that it was not its fault."""
    return problem(500, f"the service failed on this request ({type(error).__name__}); its log has the traceback")


def add_problem_handlers(app: FastAPI) -> None:
    """Makes every error of the app a problem document."""
    for kind in STATUS_OF_ERROR:
        app.add_exception_handler(kind, _known_error)
    app.add_exception_handler(RequestValidationError, _invalid_request)
    app.add_exception_handler(HTTPException, _http_error)
    app.add_exception_handler(Exception, _unknown_error)
