"""A search worker's entry in the catalog: that it lives, and what it has loaded."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping, Sequence
from uuid import UUID

from sqlalchemy.exc import SQLAlchemyError

from services.search.worker import SearchWorker
from shared.catalog.away import OutageLog
from shared.catalog.search_workers import delete_search_worker, upsert_search_worker
from shared.catalog.session import Catalog
from shared.ids import new_id

log = logging.getLogger(__name__)

CHANGE_POLL_SECONDS = 0.5  # between two looks at what is loaded: a switch waits for the news
HEARTBEAT_SECONDS = 2.0  # between two entries without news; DEAD_SECONDS is five of them


class WorkerHeartbeat:
    """Writes the entry. A thread of its own: loading may take minutes, and who loads lives."""

    def __init__(
        self, catalog: Catalog, worker: SearchWorker, name: str, url: str | None = None
    ) -> None:
        self.id = new_id()
        self._catalog = catalog
        self._worker = worker
        self._name = name
        self._url = url
        self._sent_versions: tuple[Mapping[UUID, int], Sequence[str]] | None = None
        self._sent_at = 0.0

    def run(self, stop: threading.Event) -> None:
        """Keep the entry until `stop` is set, and remove it then."""
        outage = OutageLog("search worker's entry")
        while not stop.is_set():
            try:
                self.send_if_due()
                outage.record_success()
            except SQLAlchemyError as error:
                outage.record_error(error)
            stop.wait(CHANGE_POLL_SECONDS)
        try:
            with self._catalog.write() as session:
                delete_search_worker(session, self.id)
        except SQLAlchemyError as error:
            log.warning("search could not sign off, the steward will: %s", error)

    def send_if_due(self) -> None:
        """Write what there is to tell: news at once, else a heartbeat when it is due."""
        status = self._worker.status()
        news = status.loaded, status.missing
        if news == self._sent_versions and time.monotonic() - self._sent_at < HEARTBEAT_SECONDS:
            return
        with self._catalog.write() as session:
            upsert_search_worker(session, self.id, self._name, self._url, self._worker.shard, *news)
        self._sent_versions, self._sent_at = news, time.monotonic()
