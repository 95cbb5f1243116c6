"""Database errors: separates outages (unreachable, busy, full, damaged) from bugs, and logs them.

Outages become `Unavailable` errors that a client may retry; any other error, such as a violated
constraint, is raised unchanged.
"""

from __future__ import annotations

import logging
import re

from sqlalchemy.exc import DBAPIError, InterfaceError, InternalError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeout

from shared.errors import StorageFull, Unavailable

log = logging.getLogger(__name__)

ROLLBACK_SQLSTATES = {"40001": "serialization failure", "40P01": "deadlock"}
TIMEOUT_SQLSTATES = {"57014": "the statement timed out", "55P03": "waiting for a lock timed out"}
READ_ONLY_SQLSTATE = "25006"  # the old primary, after a failover
POSTGRES_FULL = "53100"
POSTGRES_DAMAGED = ("XX001", "XX002")
DAMAGED = ("SQLITE_CORRUPT", "SQLITE_NOTADB")
"""Prefixes of the names of SQLite errors that mean a damaged file."""
FULL_RETRY_SECONDS = 60
# In messages of connections that fail, for which libpq gives no SQLSTATE.
PERMANENT_FAILURES = re.compile(
    "authentication failed|does not exist|no pg_hba.conf entry|not permitted to log in|"
    "permission denied|no password supplied"
)


def get_sqlstate(error: BaseException) -> str | None:
    """Return the five-character SQLSTATE of a PostgreSQL error; None for other errors."""
    return getattr(getattr(error, "orig", None), "sqlstate", None)


def to_unavailable(error: BaseException) -> Unavailable | None:
    """Convert a database error to the error for clients if the catalog can't be used right now.

    Returns:
        `Unavailable` (`catalog_busy`, `catalog_unavailable`, `catalog_damaged`, `catalog_io_error`)
        or `StorageFull` (`disk_full`); None for any other error, such as a violated constraint.
    """
    if isinstance(error, PoolTimeout):
        return _catalog_busy_error("every connection is in use")
    if not isinstance(error, DBAPIError):
        return None
    state = get_sqlstate(error)
    sqlite = str(getattr(error.orig, "sqlite_errorname", ""))
    if sqlite == "SQLITE_FULL" or state == POSTGRES_FULL:
        return StorageFull(
            "disk_full",
            "The catalog's disk is full; nothing was changed. Free disk space on it, or "
            "empty the trash of photos, or delete maps.",
            retry_after_seconds=FULL_RETRY_SECONDS,
        )
    if sqlite.startswith(DAMAGED) or state in POSTGRES_DAMAGED:
        return Unavailable(
            "catalog_damaged",
            f"The catalog is damaged ({reason_of(error)}); nothing was changed. Stop the server, "
            "then restore a backup or rebuild the catalog; placewise doctor shows how.",
        )
    if sqlite.startswith("SQLITE_IOERR"):
        return Unavailable(
            "catalog_io_error",
            f"The catalog's disk has failed ({reason_of(error)}); nothing was changed. Check the "
            "disk's free space and the system log (dmesg), and take a backup.",
        )
    if state in TIMEOUT_SQLSTATES:
        return _catalog_busy_error(TIMEOUT_SQLSTATES[state])
    if state in ROLLBACK_SQLSTATES:
        return _catalog_busy_error(ROLLBACK_SQLSTATES[state])
    lost = isinstance(error, OperationalError | InterfaceError) or error.connection_invalidated
    if lost or (isinstance(error, InternalError) and state == READ_ONLY_SQLSTATE):
        return Unavailable(
            "catalog_unavailable", "The catalog is unreachable. Try again in a moment."
        )
    return None


def explain_outage(error: BaseException) -> Unavailable | None:
    """Convert a database error as `to_unavailable` does, with the details for an operator.

    The detail of `catalog_unavailable` names the host, the database and the driver's reason, and
    says whether the failure passes by itself. Responses to clients must not contain it.
    """
    unavailable = to_unavailable(error)
    if unavailable is None or unavailable.code != "catalog_unavailable":
        return unavailable
    advice = (
        "This will not pass by itself: correct DATABASE_URL, or the users and the pg_hba.conf of "
        "the server."
        if is_permanent(error)
        else "This may pass: the server may be starting, overloaded or disconnected. If it lasts, "
        "check the host and the port in DATABASE_URL."
    )
    reason = reason_of(error).rstrip(".")
    return Unavailable("catalog_unavailable", f"The catalog is unreachable: {reason}. {advice}")


def is_permanent(error: BaseException) -> bool:
    """Return whether a connection fails until somebody changes the settings or the server."""
    return PERMANENT_FAILURES.search(reason_of(error)) is not None


def _catalog_busy_error(reason: str) -> Unavailable:
    return Unavailable(
        "catalog_busy",
        f"The catalog is too busy ({reason}). Try again in a moment; if it happens again, request "
        "less at once.",
    )


class OutageLog:
    """Logs the beginning and the end of a catalog outage once each; every loop has its own.

    Args:
        component: Name of the loop in log lines.
    """

    def __init__(self, component: str) -> None:
        self._component = component
        self._is_outage = False

    def record_error(self, error: Exception) -> None:
        """Record an error of the loop; an error that is no outage is logged with its traceback."""
        unavailable = to_unavailable(error)
        if unavailable is None:
            log.error("the %s got an error from the catalog", self._component, exc_info=error)
        elif not self._is_outage:
            self._is_outage = True
            log.warning("the %s waits for the catalog: %s", self._component, reason_of(error))

    def record_success(self) -> None:
        """Record an iteration of the loop without an error."""
        if self._is_outage:
            self._is_outage = False
            log.warning("the %s can use the catalog again", self._component)


def reason_of(error: BaseException) -> str:
    """Return the first line of the database's own message, without the statement."""
    return str(getattr(error, "orig", None) or error).strip().split("\n", 1)[0]
