"""A search worker's entry in the catalog: that it lives, and what it has loaded."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping, Sequence
from uuid import UUID

from sqlalchemy.exc import SQLAlchemyError

from services.search.worker import SearchWorker
from shared.catalog.away import Outage
from shared.catalog.search_workers import forget_worker, tell_of_worker
from shared.catalog.session import Catalog
from shared.ids import new_id

log = logging.getLogger(__name__)

LOOK_SECONDS = 0.5  # between two looks at what is loaded: a switch waits for the news
HEARTBEAT_SECONDS = 2.0  # between two entries without news; DEAD_SECONDS is five of them


class Presence:
    """Writes the entry. A thread of its own: loading may take minutes, and who loads lives."""

    def __init__(
        self, catalog: Catalog, worker: SearchWorker, name: str, url: str | None = None
    ) -> None:
        self.id = new_id()
        self._catalog = catalog
        self._worker = worker
        self._name = name
        self._url = url
        self._told: tuple[Mapping[UUID, int], Sequence[str]] | None = None
        self._told_at = 0.0

    def run(self, stop: threading.Event) -> None:
        """Keep the entry until `stop` is set, and remove it then."""
        outage = Outage("search worker's entry")
        while not stop.is_set():
            try:
                self.tell()
                outage.over()
            except SQLAlchemyError as error:
                outage.met(error)
            stop.wait(LOOK_SECONDS)
        try:
            with self._catalog.write() as session:
                forget_worker(session, self.id)
        except SQLAlchemyError as error:
            log.warning("search could not sign off, the steward will: %s", error)

    def tell(self) -> None:
        """Write what there is to tell: news at once, else a heartbeat when it is due."""
        status = self._worker.status()
        news = status.loaded, status.missing
        if news == self._told and time.monotonic() - self._told_at < HEARTBEAT_SECONDS:
            return
        with self._catalog.write() as session:
            tell_of_worker(session, self.id, self._name, self._url, self._worker.shard, *news)
        self._told, self._told_at = news, time.monotonic()
