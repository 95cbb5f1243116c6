"""Everything in one process, no servers: gateway, extractor, search and steward on SQLite and a
local folder (with S3_ENDPOINT, a bucket). These are the very classes that the separate services
run; only the ports differ:

| port | here | between machines |
|---|---|---|
| hints | an event | a Celery message |
| object store | a folder | S3 |
| search protocol | a call | HTTP |
| catalog | SQLite | PostgreSQL |
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import uvicorn
from prometheus_client import CollectorRegistry

from services.extractor.worker import ExtractorWorker
from services.gateway.app import create_app
from services.gateway.authentication import (
    ApiKeyAuthenticator,
    Authenticator,
    LocalhostAuthenticator,
)
from services.gateway.dependencies import GatewayContext
from services.http_server import http_server, listen, reachable_url, stop_on_signals
from services.search.metrics import MeteredSearch
from services.search.service import WorkerHeartbeat
from services.search.worker import SearchWorker
from services.service_threads import start_service_thread
from services.steward.batches.worker import BatchWorker
from services.steward.evaluation_worker import EvaluationWorker
from services.steward.metrics import StewardMetrics
from services.steward.scheduler import Scheduler
from services.steward.tasks.maintenance import release_expired_leases
from services.steward.webhooks import WebhookDispatcher
from shared.catalog.api_keys import create_api_key, has_admin_key
from shared.catalog.file_checks import sqlite_file
from shared.catalog.installation import check_before_new_catalog, open_installation_store
from shared.catalog.maps import get_or_create_default_map
from shared.catalog.processes import delete_dead_search_workers
from shared.catalog.schema import migrate
from shared.catalog.session import Catalog, TransactionTimeouts
from shared.catalog.tables import open_catalog
from shared.config.disk_space import DiskReserve
from shared.config.embedded_home import announce_server, lock_home
from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.jobs import InProcessWakeups
from shared.security.api_keys import Scope, generate_local_key, hash_api_key, is_loopback
from shared.telemetry.metrics_server import serve_metrics

log = logging.getLogger(__name__)


@dataclass(slots=True)
class Standalone:
    """A running embedded Placewise."""

    url: str
    """An address of it that this machine reaches."""
    server: uvicorn.Server
    listener: socket.socket
    first_admin_key: str | None
    """The first admin key, where this start has made it: to be shown now or never."""
    local_key: str | None
    """A key for the commands of this user; None on loopback without ADMIN_KEY: none is needed."""
    failed: threading.Event
    """Set when one of the parts has died: the process should end and say so."""

    def stop(self) -> None:
        """A part has died: stop the others."""
        self.failed.set()
        self.server.should_exit = True

    def serve(self) -> None:
        """Answer HTTP until the process is asked to stop."""
        with stop_on_signals(self.server):
            self.server.run(sockets=[self.listener])
        if self.failed.is_set():
            raise Misconfigured("part_died", "A part of Placewise died; the log above says why.")


@contextlib.contextmanager
def run_standalone(settings: Settings) -> Iterator[Standalone]:
    """Lock the folder, recover what a killed process left, and start every part.

    Beyond loopback, or with an ADMIN_KEY, every call needs a key; where there is no admin's yet,
    the first one is made. Raises Misconfigured: `home_in_use` for a folder that another server has,
    `address_in_use`, `separate_services` where SEARCH_URLS is set, and those of
    `open_installation_store`;
    Unavailable for a bucket that can't be used.
    """
    if settings.search_worker_urls:
        raise Misconfigured(
            "separate_services",
            "SEARCH_URLS names search workers, and the embedded Placewise asks none: it searches "
            "in its own process, and takes every lease for a dead worker's. Unset SEARCH_URLS, or "
            "run placewise gateway, extractor and steward.",
        )
    home = settings.placewise_home
    with contextlib.ExitStack() as held:
        held.enter_context(lock_home(home))
        listener = held.enter_context(listen(settings.host, settings.port))
        catalog = open_catalog(settings, "embedded")
        held.callback(catalog.close)
        if (file := sqlite_file(catalog)) is not None:
            DiskReserve(file.parent, settings.min_free_bytes).release()
        check_before_new_catalog(catalog, settings)
        migrate(catalog)
        store = open_installation_store(catalog, settings, exclusive=True)
        hints = InProcessWakeups()
        with catalog.write() as session:
            get_or_create_default_map(session, settings.new_map_extractor)
            # The lock says that no other worker lives: what is there is left by a killed process.
            delete_dead_search_workers(session, all_workers=True)
        release_expired_leases(catalog, settings.max_attempts, all_leases=True)

        # After all that can be refused: a key that no start gets to show would be lost.
        host, port = listener.getsockname()[:2]
        requests = catalog.with_timeouts(TransactionTimeouts.for_requests(settings))
        keys, made_key, local_key = _create_authenticator(settings, host, requests)
        url = reachable_url(host, port)
        held.enter_context(announce_server(home, url, local_key))

        registry = CollectorRegistry()  # of all parts: one /metrics tells of everything
        search = SearchWorker(catalog, store, settings)
        name = f"embedded-{os.getpid()}"
        presence = WorkerHeartbeat(catalog, search, name)
        extractor = ExtractorWorker(
            catalog, store, settings, name=name, only_worker=True, registry=registry
        )
        stewards = StewardMetrics(registry)
        steward = Scheduler(catalog, store, hints, settings, stewards)
        evaluator = EvaluationWorker(catalog, store, search, settings, name, stewards)
        webhooks = WebhookDispatcher(catalog, settings)
        batches = BatchWorker(catalog, store, hints, settings, name, stewards)
        counted = MeteredSearch(search, registry)
        gateway = GatewayContext(requests, store, hints, counted, settings, keys, registry)
        server = http_server(
            create_app(gateway), gateway.connections, on_stop=gateway.job_notifier.begin_shutdown
        )
        held.enter_context(serve_metrics(settings, registry))
        running = Standalone(url, server, listener, made_key, local_key, threading.Event())
        stop = threading.Event()
        parts = [
            start_service_thread(name, part, stop, running.stop)
            for name, part in (
                ("search", search.run),
                ("search of what is built", search.run_building),
                ("search's presence", presence.run),
                ("extractor", partial(extractor.run, hints=hints)),
                ("steward", steward.run),
                ("evaluator", evaluator.run),
                ("batches", batches.run),
                ("webhooks", webhooks.run),
            )
        ]
        try:
            yield running
        finally:
            stop.set()
            hints.send()
            for part in parts:
                part.join()
            extractor.close()


def _create_authenticator(
    settings: Settings, host: str, catalog: Catalog
) -> tuple[Authenticator, str | None, str | None]:
    """What the gateway asks, the first admin key if it is made now, and a key for this user's
    commands."""
    # The name as well as what it means today: what a name leads to can change.
    if settings.admin_key is None and is_loopback(settings.host) and is_loopback(host):
        return LocalhostAuthenticator(settings.allowed_origins), None, None
    local_key, made_key = generate_local_key(), None
    admins = [hash_api_key(local_key)]
    if settings.admin_key is not None:
        admins.append(hash_api_key(settings.admin_key.get_secret_value()))
    else:
        with catalog.write() as session:
            if not has_admin_key(session):
                _, made_key = create_api_key(session, "made at the first start", [Scope.ADMIN])
    return ApiKeyAuthenticator(catalog, *admins), made_key, local_key
