"""Secrets that are known to the process are cut out of every log line and every problem document."""

import logging
from collections.abc import Iterable

_MASK = "[secret]"
_MIN_LENGTH = 4  # shorter ones would tear other words apart
_secrets: list[str] = []


def register_secrets(secrets: Iterable[str]) -> None:
    """Texts to be cut out from now on, for the life of the process."""
    _secrets.extend(secret for secret in secrets if len(secret) >= _MIN_LENGTH and secret not in _secrets)
    _secrets.sort(key=len, reverse=True)


def redact(text: str) -> str:
    """The text without any registered secret."""
    for secret in _secrets:
        text = text.replace(secret, _MASK)
    return text


class RedactingFilter(logging.Filter):
    """For handlers: no secret in messages, arguments and tracebacks, no query string in access lines.

    Query strings are left out altogether: a client that puts its token there by mistake should not find it in a
    log, and this service does not know every client's secrets.
    """

    def filter(self, record: logging.LogRecord) -> bool:
        if isinstance(record.args, tuple):
            arguments = list(record.args)
            if record.name == "uvicorn.access" and len(arguments) == 5:
                arguments[2] = str(arguments[2]).partition("?")[0]
            record.args = tuple(redact(value) if isinstance(value, str) else value for value in arguments)
        if record.name != "uvicorn.access":
            message = record.getMessage()
            if (clean := redact(message)) != message:
                record.msg, record.args = clean, ()
        if record.exc_info:
            record.exc_text = redact(record.exc_text or logging.Formatter().formatException(record.exc_info))
        return True


def redact_logs() -> None:
    """Puts the filter on every handler that exists: call it once logging is configured."""
    known = [logging.getLogger(), *(logging.getLogger(name) for name in list(logging.root.manager.loggerDict))]
    for logger in known:
        for handler in logger.handlers:
            if not any(isinstance(present, RedactingFilter) for present in handler.filters):
                handler.addFilter(RedactingFilter())
