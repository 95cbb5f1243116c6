"""Journal task: writes pending catalog rows to the journal in the object store.

Also the conditions under which deleted rows may lose their objects: the journal has to record a
deletion first, or a catalog rebuilt from it would restore the row.
"""

from __future__ import annotations

import logging

from sqlalchemy import or_, select

from services.steward.metrics import StewardMetrics
from shared.catalog.database.base import Condition, db_now_plus, is_journaled
from shared.catalog.database.session import Catalog
from shared.catalog.maps import Map
from shared.catalog.photos import Photo
from shared.errors import Unavailable
from shared.journal.outbox import Lag, catalog_lag, write_journal
from shared.storage import ObjectStore

log = logging.getLogger(__name__)

# A full object store accepts no journal segment, and only deletions free space. A photo that is
# deleted before the journal records it does not come back either: without its original it is not
# rebuilt.
MAX_JOURNAL_WAIT_SECONDS = 60.0


class JournalTask:
    """Writes pending rows to the journal, and reports a catalog that is older than its store.

    The catalog is compared with the store in the first run and as long as it is behind. The log
    says when that begins and ends.
    """

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
            log.info("the journal is written again: the catalog is no longer behind its store")
        self._lag = lag


def journal_deletions(catalog: Catalog, store: ObjectStore, table: type[Photo] | type[Map]) -> None:
    """Write the journal if it lacks deletions of the table; log a warning if the store refuses."""
    pending = select(table.id).where(table.deleted_at.is_not(None), ~is_journaled(table))
    with catalog.read() as session:
        if session.scalar(pending.limit(1)) is None:
            return
    try:
        write_journal(catalog, store)
    except Unavailable as error:
        log.warning("deletions could not be written to the journal: %s", error)


def deletion_is_journaled(table: type[Photo] | type[Map]) -> Condition:
    """Condition for deleted rows whose objects may be deleted: the journal records the deletion, or
    could not be written for MAX_JOURNAL_WAIT_SECONDS."""
    return or_(is_journaled(table), table.deleted_at < db_now_plus(-MAX_JOURNAL_WAIT_SECONDS))
