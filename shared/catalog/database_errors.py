"""What a failing catalog means: away, too busy, a transaction sacrificed, full, damaged, or a bug.

Only the first four are worth another try; whoever has a bug in his statement must hear of it.
"""

from __future__ import annotations

import logging

from sqlalchemy.exc import DBAPIError, InterfaceError, InternalError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeout

from shared.errors import StorageFull, Unavailable

log = logging.getLogger(__name__)

ROLLBACK_SQLSTATES = {"40001": "serialization failure", "40P01": "deadlock"}
TIMEOUT_SQLSTATES = {"57014": "the statement took too long", "55P03": "a lock was not to be had"}
READ_ONLY_SQLSTATE = "25006"  # the old primary, after a failover
POSTGRES_FULL = "53100"
POSTGRES_DAMAGED = ("XX001", "XX002")
DAMAGED = ("SQLITE_CORRUPT", "SQLITE_NOTADB")
"""How the names of SQLite's errors begin that mean a damaged file."""
FULL_RETRY_SECONDS = 60


def get_sqlstate(error: BaseException) -> str | None:
    """PostgreSQL's five characters; None for what came from elsewhere."""
    return getattr(getattr(error, "orig", None), "sqlstate", None)


def to_unavailable(error: BaseException) -> Unavailable | None:
    """What to tell whoever asked when the catalog can't be used right now; None for what is no
    such error (a violated constraint, say)."""
    if isinstance(error, PoolTimeout):
        return _catalog_busy_error("every connection is in use")
    if not isinstance(error, DBAPIError):
        return None
    state = get_sqlstate(error)
    sqlite = str(getattr(error.orig, "sqlite_errorname", ""))
    if sqlite == "SQLITE_FULL" or state == POSTGRES_FULL:
        return StorageFull(
            "disk_full",
            "The disk of the catalog is full: nothing was changed. Make room on it, or delete "
            "photos or maps.",
            retry_after_seconds=FULL_RETRY_SECONDS,
        )
    if sqlite.startswith(DAMAGED) or state in POSTGRES_DAMAGED:
        return Unavailable(
            "catalog_damaged",
            f"The catalog is damaged ({reason_of(error)}): nothing was changed. Stop the server, "
            "then restore a backup or rebuild the catalog; placewise doctor says how.",
        )
    if sqlite.startswith("SQLITE_IOERR"):
        return Unavailable(
            "catalog_io_error",
            f"The catalog's disk has failed ({reason_of(error)}): nothing was changed. Look at the "
            "disk's free space and at the system's log (dmesg), and take a backup.",
        )
    if state in TIMEOUT_SQLSTATES:
        return _catalog_busy_error(TIMEOUT_SQLSTATES[state])
    if state in ROLLBACK_SQLSTATES:
        return _catalog_busy_error(ROLLBACK_SQLSTATES[state])
    away = isinstance(error, OperationalError | InterfaceError) or error.connection_invalidated
    if away or (isinstance(error, InternalError) and state == READ_ONLY_SQLSTATE):
        return Unavailable(
            "catalog_unavailable", "The catalog can't be reached right now. Try again in a moment."
        )
    return None


def _catalog_busy_error(why: str) -> Unavailable:
    return Unavailable(
        "catalog_busy",
        f"The catalog is too busy right now ({why}). Try again in a moment, and ask for less at "
        "once if it happens again.",
    )


class OutageLog:
    """Says once that the catalog is away, and once that it is back: one for each loop."""

    def __init__(self, who: str) -> None:
        self._who = who
        self._away = False

    def record_error(self, error: Exception) -> None:
        """`error` ended a round of the loop. What is no outage is logged in full each time."""
        unavailable = to_unavailable(error)
        if unavailable is None:
            log.error("the %s met an error in the catalog", self._who, exc_info=error)
        elif not self._away:
            self._away = True
            log.warning("the %s waits for the catalog: %s", self._who, reason_of(error))

    def record_success(self) -> None:
        """A round went well."""
        if self._away:
            self._away = False
            log.warning("the %s has the catalog back", self._who)


def reason_of(error: BaseException) -> str:
    """The database's own words, without the statement."""
    return str(getattr(error, "orig", None) or error).strip().split("\n", 1)[0]
