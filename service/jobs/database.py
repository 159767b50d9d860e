"""The job database: SQLite in WAL mode by default, PostgreSQL by URL where several replicas serve one store."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import Engine, create_engine, event, func, select, text
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, NoSuchModuleError, SQLAlchemyError
from sqlalchemy.orm import Session, sessionmaker

from service.errors import JobDatabaseError, OptionError
from service.jobs.models import SCHEMA_VERSION, Base, Schema

FILE_NAME = "jobs.sqlite"
BUSY_TIMEOUT_MS = 20_000
_SCHEMA_LOCK = 7_103_254  # any number that no other user of the PostgreSQL database locks
_WRITES = "lightwell_writes"


def default_url(store_url: str) -> str:
    """The SQLite file beside a local store's units.

    Raises:
        OptionError: the store is not on this machine, so the place has to be said.
    """
    if "://" in store_url and not store_url.startswith("file://"):
        raise OptionError(
            f"database must be given for a store that is no local folder, got none for {store_url}; "
            "set LIGHTWELL_DATABASE_URL=sqlite:///PATH or postgresql://..."
        )
    return f"sqlite:///{Path(store_url.removeprefix('file://')) / FILE_NAME}"


def parse_url(url: str) -> URL:
    """The URL with the driver that we ship: psycopg for PostgreSQL.

    Raises:
        OptionError: neither SQLite nor PostgreSQL; the message does not repeat a password.
    """
    try:
        parsed = make_url(url)
    except ArgumentError:
        raise OptionError("database must be a URL such as sqlite:///jobs.sqlite or postgresql://host/name") from None
    if parsed.drivername in ("postgresql", "postgres"):
        parsed = parsed.set(drivername="postgresql+psycopg")
    if parsed.get_backend_name() not in ("sqlite", "postgresql"):
        raise OptionError(f"database must be sqlite or postgresql, got {parsed.drivername}")
    return parsed


class Database:
    """Connections to the job database, and the two kinds of transactions.

    Args:
        url: sqlite:///PATH or postgresql://...; the tables are made where there are none.

    Raises:
        OptionError: the URL is of no database that we support.
        JobDatabaseError: it cannot be reached, or holds tables of another version.
    """

    def __init__(self, url: str) -> None:
        parsed = parse_url(url)
        self.is_sqlite = parsed.get_backend_name() == "sqlite"
        self.shown_url = parsed.render_as_string(hide_password=True)
        try:
            self.engine = _sqlite_engine(parsed) if self.is_sqlite else create_engine(parsed, pool_pre_ping=True)
        except (ImportError, NoSuchModuleError) as error:
            raise OptionError(f"database {self.shown_url} needs a driver: pip install 'lightwell[postgres]'") from error
        self._reading = sessionmaker(self.engine, expire_on_commit=False)
        self._writing = sessionmaker(self.engine.execution_options(**{_WRITES: True}), expire_on_commit=False)
        try:
            self._create_tables()
        except JobDatabaseError:
            self.close()
            raise
        except SQLAlchemyError as error:
            self.close()
            cause = getattr(error, "orig", None) or error
            raise JobDatabaseError(
                f"job database {self.shown_url} must be reachable and writable, got {type(cause).__name__}: "
                f"{' '.join(str(cause).split())}"
            ) from error

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """A transaction that changes nothing."""
        with self._reading() as session, session.begin():
            yield session

    @contextmanager
    def writing(self) -> Iterator[Session]:
        """A transaction that may write; on SQLite it takes the write lock at once, so it never loses a race later."""
        with self._writing() as session, session.begin():
            yield session

    def now_s(self, session: Session) -> float:
        """Seconds since 1970 by the clock that all replicas share."""
        if self.is_sqlite:
            return time.time()
        return float(session.scalar(select(func.extract("epoch", func.clock_timestamp()))) or 0.0)

    def close(self) -> None:
        """Closes every connection."""
        self.engine.dispose()

    def _create_tables(self) -> None:
        with self.writing() as session:
            if not self.is_sqlite:  # two replicas may start at once
                session.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": _SCHEMA_LOCK})
            Base.metadata.create_all(session.connection())
            versions = list(session.scalars(select(Schema.version)))
            if not versions:
                session.add(Schema(version=SCHEMA_VERSION))
            elif versions != [SCHEMA_VERSION]:
                raise JobDatabaseError(
                    f"job database {self.shown_url} must have schema version {SCHEMA_VERSION}, got {versions}; "
                    "open it with the release that wrote it, or give another database"
                )


def _sqlite_engine(url: URL) -> Engine:
    """An engine whose transactions begin when we say so, with a log that readers do not wait for."""
    if url.database and url.database != ":memory:":
        Path(url.database).parent.mkdir(parents=True, exist_ok=True)
    engine = create_engine(url)

    @event.listens_for(engine, "connect")
    def configure(connection: Any, _: Any) -> None:
        connection.isolation_level = None  # the driver must not begin transactions of its own
        cursor = connection.cursor()
        cursor.execute(f"PRAGMA busy_timeout = {BUSY_TIMEOUT_MS}")
        cursor.execute("PRAGMA journal_mode = WAL")
        cursor.execute("PRAGMA synchronous = FULL")  # a job that was accepted survives a power cut
        cursor.execute("PRAGMA foreign_keys = ON")
        cursor.close()

    @event.listens_for(engine, "begin")
    def begin(connection: Any) -> None:
        writes = connection.get_execution_options().get(_WRITES)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")

    return engine
