"""The steward's duty for the journal, and what waits for it."""

from __future__ import annotations

import logging

from sqlalchemy import or_, select

from services.steward.metrics import StewardMetrics
from shared.catalog.base import Condition, db_now_plus, is_journaled
from shared.catalog.maps import Map
from shared.catalog.photos import Photo
from shared.catalog.session import Catalog
from shared.errors import Unavailable
from shared.journal.outbox import Lag, catalog_lag, write_journal
from shared.storage import ObjectStore

log = logging.getLogger(__name__)

# A full object store takes no journal, and only deleting makes room in it. What is deleted before
# the journal tells of it does not come back either: a photo without its original is not rebuilt.
PATIENCE_SECONDS = 60.0


class JournalDuty:
    """Writes what is pending. Compares the catalog with the store at the first round and while it
    is behind; logs when that begins and ends."""

    def __init__(self, catalog: Catalog, store: ObjectStore, metrics: StewardMetrics) -> None:
        self._catalog = catalog
        self._store = store
        self._metrics = metrics
        self._lag: Lag | None = None
        self._compared = False

    def __call__(self) -> None:
        written = write_journal(self._catalog, self._store)
        self._metrics.journal_lines.inc(written.lines)
        lag = written.lag
        if lag is None and (self._lag is not None or not self._compared):
            lag = catalog_lag(self._catalog, self._store)
        self._compared = True
        self._metrics.catalog_lag_segments.set(lag.segments if lag else 0)
        if lag is not None and self._lag is None:
            log.error("the journal is not written: %s", lag.detail)
        elif lag is None and self._lag is not None:
            log.info("the journal is written again: the catalog knows all that it holds")
        self._lag = lag


def journal_deletions(catalog: Catalog, store: ObjectStore, table: type[Photo] | type[Map]) -> None:
    """Write the journal where deletions are pending; a store that takes nothing is logged."""
    pending = select(table.id).where(table.deleted_at.is_not(None), ~is_journaled(table))
    with catalog.read() as session:
        if session.scalar(pending.limit(1)) is None:
            return
    try:
        write_journal(catalog, store)
    except Unavailable as error:
        log.warning("deletions are not journaled: %s", error)


def deletion_is_journaled(table: type[Photo] | type[Map]) -> Condition:
    """True for deleted rows whose bytes may go: the journal tells of their deletion, or could not
    be written for PATIENCE_SECONDS."""
    return or_(is_journaled(table), table.deleted_at < db_now_plus(-PATIENCE_SECONDS))
