"""The embedded server: gateway, search and steward in one process, the extractor in another.

It needs no other servers: it uses SQLite and a local folder, or a bucket if S3_ENDPOINT is set. It
runs the same classes as the separate services with other adapters, which the first table of
docs/architecture.md lists.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import uvicorn
from prometheus_client import CollectorRegistry

from services.embedded_extractor import ExtractorProcess, extractor_lock
from services.gateway.app import create_app
from services.gateway.authentication import (
    ApiKeyAuthenticator,
    Authenticator,
    LocalhostAuthenticator,
)
from services.gateway.dependencies import GatewayContext
from services.gateway.proxy_sign_in import with_proxy_sign_in
from services.http_server import http_server, lan_url, listen, reachable_url, stop_on_signals
from services.search.metrics import MeteredSearch
from services.search.worker import SearchWorker
from services.service_process import start_service_threads, stop_when_a_thread_crashes
from services.steward.batches.worker import BatchWorker
from services.steward.evaluation_worker import EvaluationWorker
from services.steward.library_sync import LibrarySyncWorker
from services.steward.metrics import StewardMetrics
from services.steward.scheduler import Scheduler
from services.steward.tasks.maintenance import reclaim_leases
from services.steward.webhooks import WebhookDispatcher
from shared.catalog.api_keys import create_api_key, has_admin_key
from shared.catalog.database.schema import migrate
from shared.catalog.database.session import REQUEST_TIMEOUTS, Catalog
from shared.catalog.installation import check_before_new_catalog, open_installation_store
from shared.catalog.maps import get_or_create_default_map
from shared.catalog.processes import delete_processes, process_heartbeat
from shared.catalog.tables import open_catalog
from shared.config.embedded_home import announce_server, lock_home
from shared.config.settings import Settings
from shared.errors import Misconfigured, PlacewiseError
from shared.jobs import InProcessWakeups
from shared.security.api_keys import Scope, generate_local_key, hash_api_key, is_loopback
from shared.telemetry.logs import configure_logging
from shared.telemetry.metrics_server import serve_metrics


@dataclass(slots=True)
class Standalone:
    """A running embedded server."""

    url: str
    """Its URL, reachable from this machine."""
    lan_url: str | None
    """Its URL for other devices of the network; None if only this machine can reach it."""
    server: uvicorn.Server
    listener: socket.socket
    first_admin_key: str | None
    """The first admin key if this start has created it. It can't be shown again later."""
    local_key: str | None
    """Key for the CLI of this user; None on loopback without ADMIN_KEY, where no key is needed."""
    error: PlacewiseError | None = None
    """Why the extractor could not start: the process must end with this error."""

    def stop(self, error: PlacewiseError | None = None) -> None:
        """Stop the server; `serve` then raises the error, if there is one."""
        self.error = error
        self.server.should_exit = True

    def serve(self) -> None:
        """Serve HTTP until the process is stopped by a signal.

        Raises:
            PlacewiseError: As the extractor's start raises it.
        """
        with stop_on_signals(self.server):
            self.server.run(sockets=[self.listener])
        if self.error is not None:
            raise self.error


def serve_standalone(settings: Settings, on_ready: Callable[[Standalone], None]) -> None:
    """Run all services until the process is stopped by a signal; `on_ready` once it listens.

    Raises:
        PlacewiseError: As `run_standalone` and `Standalone.serve` raise it.
    """
    configure_logging(settings, "embedded", for_operators=False)
    with run_standalone(settings) as running:
        on_ready(running)
        running.serve()


@contextlib.contextmanager
def run_standalone(settings: Settings, *, lazy_extractor: bool = False) -> Iterator[Standalone]:
    """Context manager that starts all services and stops them at the end.

    The extractor's process is started at once, or with `lazy_extractor` when the first of its jobs
    is queued.

    Locks PLACEWISE_HOME first. If the catalog is in that folder, the leases and registrations of a
    killed process are deleted; with DATABASE_URL they may be those of running services, and expire.
    If HOST is not a loopback address, or ADMIN_KEY is set, every request needs a key; the first
    admin key is created if there is none.

    Raises:
        Misconfigured: `home_in_use` if another server uses the folder, `address_in_use`,
            `separate_services` if SEARCH_URLS is set, `thread_crashed` at the end if a thread has
            crashed, and those of `open_installation_store`.
        Unavailable: The bucket can't be used.
    """
    if settings.search_worker_urls:
        raise Misconfigured(
            "separate_services",
            "SEARCH_URLS is set, but the embedded server searches in its own process. Unset "
            "SEARCH_URLS, or run placewise gateway, extractor and steward.",
        )
    home, name = settings.placewise_home, f"embedded-{os.getpid()}"
    with contextlib.ExitStack() as stack:
        extractor = ExtractorProcess(settings, name, lazy=lazy_extractor)
        stack.callback(extractor.end)
        stack.enter_context(lock_home(home))
        with extractor_lock(home):
            pass  # the extractor of a server that was killed has ended
        listener = stack.enter_context(listen(settings.host, settings.port))
        catalog = open_catalog(settings, "embedded")
        stack.callback(catalog.close)
        check_before_new_catalog(catalog, settings)
        migrate(catalog)
        store = open_installation_store(catalog, settings, exclusive=True)
        wakeups = InProcessWakeups(extractor.look)
        with catalog.write() as session:
            get_or_create_default_map(session, settings.new_map_extractor, settings.descriptor_rows)
        if settings.database_url is None:
            # The lock proves that no other worker is alive: rows are left from a killed process.
            with catalog.write() as session:
                delete_processes(session)
            reclaim_leases(catalog, wakeups, all_leases=True)

        registry = CollectorRegistry()  # shared: /metrics has the metrics of all services
        registry.register(extractor)
        stack.enter_context(serve_metrics(settings, registry))
        # After everything that can fail: a key that is created but not shown would be lost.
        host, port = listener.getsockname()[:2]
        requests = catalog.with_timeouts(REQUEST_TIMEOUTS)
        authenticator, first_admin_key, local_key = _create_authenticator(settings, host, requests)
        url = reachable_url(host, port)
        stack.enter_context(announce_server(home, url, local_key))

        search = SearchWorker.from_settings(catalog, store, settings)
        steward_metrics = StewardMetrics(registry)
        steward = Scheduler(catalog, store, wakeups, settings, steward_metrics)
        evaluator = EvaluationWorker(catalog, store, search, settings, name, steward_metrics)
        libraries = LibrarySyncWorker(catalog, settings, name, steward_metrics)
        webhooks = WebhookDispatcher(catalog, settings)
        batches = BatchWorker(catalog, store, wakeups, settings, name, steward_metrics)
        metered_search = MeteredSearch(search, registry)
        gateway = GatewayContext(
            requests,
            store,
            wakeups,
            metered_search,
            settings,
            authenticator,
            registry,
            lan_url=lan_url(host, port),
        )
        server = http_server(
            create_app(gateway), gateway.connections, on_stop=gateway.job_notifier.begin_shutdown
        )
        running = Standalone(url, gateway.lan_url, server, listener, first_admin_key, local_key)

        def run_extractor(_stop: threading.Event) -> None:
            try:
                extractor.run(catalog)
            except PlacewiseError as error:
                running.stop(error)

        stop = threading.Event()
        stack.enter_context(stop_when_a_thread_crashes(running.stop))
        catalog.commits.announce = extractor.look
        extractor.look()
        stack.enter_context(process_heartbeat(catalog, "search", search.state))
        threads = start_service_threads(
            {
                "search": search.run,
                "search of building generations": search.run_building,
                "extractor process": run_extractor,
                "steward": steward.run,
                "evaluator": evaluator.run,
                "libraries": libraries.run,
                "batches": batches.run,
                "webhooks": webhooks.run,
            },
            stop,
        )
        try:
            yield running
        finally:
            stop.set()
            wakeups.send()
            extractor.end()
            for thread in threads:
                thread.join()


def _create_authenticator(
    settings: Settings, host: str, catalog: Catalog
) -> tuple[Authenticator, str | None, str | None]:
    """Return the authenticator, the first admin key if it is created now, and the local key."""
    # Both the configured name and the address it resolves to, which can change.
    needs_key = settings.admin_key is not None or settings.sign_in_networks
    if not needs_key and is_loopback(settings.host) and is_loopback(host):
        return LocalhostAuthenticator(settings.allowed_origins), None, None
    local_key, first_admin_key = generate_local_key(), None
    admins = [hash_api_key(local_key)]
    if settings.admin_key is not None:
        admins.append(hash_api_key(settings.admin_key.get_secret_value()))
    else:
        with catalog.write() as session:
            if not has_admin_key(session):
                _, first_admin_key = create_api_key(
                    session, "made at the first start", [Scope.ADMIN]
                )
    keys = with_proxy_sign_in(ApiKeyAuthenticator(catalog, *admins), settings)
    return keys, first_admin_key, local_key
