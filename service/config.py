"""The service's configuration: LIGHTWELL_* variables, overridden by what the command line gives."""

import os
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from pydantic import Field, SecretStr, ValidationError, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from service.errors import AccessError, OptionError
from service.schemas import DEFAULT_MAX_PIXELS, MAX_SIDE_PX
from service.serving import is_loopback

MIN_TOKEN_LENGTH = 16


class ServiceConfig(BaseSettings):
    """Everything that the service can be told; LIGHTWELL_TOKEN sets `token`, and so on."""

    model_config = SettingsConfigDict(env_prefix="LIGHTWELL_", frozen=True, extra="forbid", hide_input_in_errors=True)

    store_url: str = Field(description="folder or fsspec URL that holds everything that is computed", repr=False)
    token: SecretStr | None = Field(None, description="clients must send it: Authorization: Bearer TOKEN")
    allow_unauthenticated: bool = Field(False, description="listen beyond loopback without a token")
    host: str = Field("127.0.0.1", description="address to listen on")
    port: int = Field(8000, ge=0, le=65535, description="0 takes a free one")

    scenes_folder: Path | None = Field(None, description="scenes that jobs may name; trusted")
    bundles_folder: Path | None = Field(None, description="uploaded bundles; default: in a local store, else a cache")
    database_url: str | None = Field(None, description="jobs; default: jobs.sqlite in a local store", repr=False)
    scheduler: str | None = Field(None, description="address of a Dask scheduler; default: a cluster of its own")
    workers: int = Field(1, ge=1, le=1024, description="worker processes of that cluster")
    compile: bool = Field(False, description="try compiled networks; a frame size's first frame takes tens of seconds")
    queue_limit: int = Field(64, ge=1, description="frame requests that may wait")
    memory_limit: int = Field(4 << 30, ge=1 << 20, description="bytes of open scenes")

    max_pixels: int = Field(DEFAULT_MAX_PIXELS, ge=1, le=MAX_SIDE_PX**2, description="largest frame")
    max_spp: int = Field(65536, ge=1, description="most samples a pixel that a scene or job may ask for")
    max_depth: int = Field(65536, ge=1, description="longest path, in edges, that a scene may ask for")
    body_max_nbytes: int = Field(4 << 20, ge=1024, description="largest request body that is no upload")
    upload_max_nbytes: int = Field(1 << 30, ge=1024, description="largest upload")
    upload_max_unpacked_nbytes: int = Field(4 << 30, ge=1024, description="bytes of a bundle's files")
    upload_max_files: int = Field(10_000, ge=1, le=1_000_000, description="files and folders of a bundle")
    upload_max_ratio: float = Field(200.0, ge=1, le=2000, description="unpacked bytes over packed bytes")

    @field_validator("token")
    @classmethod
    def _usable_token(cls, token: SecretStr | None) -> SecretStr | None:
        text = token.get_secret_value() if token is not None else "-"
        if not text or not text.isascii() or not text.isprintable() or " " in text:
            raise ValueError("token must be printable ASCII without spaces, at least one letter; unset it for none")
        return token

    @property
    def is_local(self) -> bool:
        """Whether the store is a folder of this machine."""
        return "://" not in self.store_url or self.store_url.startswith("file://")

    @property
    def local_store(self) -> Path | None:
        return Path(self.store_url.removeprefix("file://")) if self.is_local else None

    @property
    def bundles_path(self) -> Path:
        """The folder of uploaded bundles. Workers on other machines must see it under the same path."""
        if self.bundles_folder is not None:
            return self.bundles_folder
        if self.local_store is not None:
            return self.local_store / "bundles"
        cache = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
        return Path(cache).expanduser() / "lightwell" / "bundles"

    def check_exposure(self) -> str | None:
        """Refuses to be open to others by accident; returns a warning where it is on purpose.

        Raises:
            AccessError: others can reach the address and nothing asks for a token.
        """
        if self.token is not None:
            short = len(self.token.get_secret_value()) < MIN_TOKEN_LENGTH
            return f"the token has under {MIN_TOKEN_LENGTH} letters and can be guessed" if short else None
        if is_loopback(self.host):
            return None
        if not self.allow_unauthenticated:
            raise AccessError(
                f"address must be of this machine alone while there is no token, got {self.host}; "
                "set LIGHTWELL_TOKEN, or give --allow-unauthenticated"
            )
        return f"{self.host} can be reached from outside and nothing asks for a token"

    def secrets(self) -> list[str]:
        """Texts that must never be seen in a log or an answer."""
        found = [self.token.get_secret_value()] if self.token is not None else []
        for url in (self.store_url, self.database_url, self.scheduler):
            password = _password(url)
            found += [text for text in {password, unquote(password)} if text]
        return found


def _password(url: str | None) -> str:
    try:
        return urlsplit(url or "").password or ""
    except ValueError:
        return ""


def load_config(**given: Any) -> ServiceConfig:
    """Environment, overridden by every value that is given and not None.

    Raises:
        OptionError: a value is not valid; the message names it and does not repeat it.
    """
    try:
        return ServiceConfig(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        reasons = "; ".join(
            f"{'.'.join(str(part) for part in reason['loc'])}: {reason['msg']}" for reason in error.errors()
        )
        raise OptionError(f"configuration must be valid, got {reasons}; see the options and LIGHTWELL_*") from None
