"""`placewise serve`: the embedded Placewise, one process.

`placewise search`: one search worker, for a shard of every map.

`placewise gateway|extractor|steward`: services in processes of their own (`search` is beside).

They share DATABASE_URL (PostgreSQL), REDIS_URL, the object store, and SEARCH_URLS. What only one of
them needs is imported there: each has an image of its own, with its own packages.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from typing import TYPE_CHECKING

from services.cli.environment import read_settings
from services.cli.output import err_console, report_errors
from services.service_threads import start_service_thread
from shared.catalog.api_keys import has_admin_key
from shared.catalog.installation import get_or_create_installation, open_installation_store
from shared.catalog.maps import get_or_create_default_map
from shared.catalog.processes import process_heartbeat
from shared.catalog.schema import migrate as migrate_catalog
from shared.catalog.schema import wait_for_schema
from shared.catalog.session import Catalog, TransactionTimeouts
from shared.catalog.tables import open_catalog
from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.search_api.client import HttpSearchClient
from shared.security.api_keys import hash_api_key, is_loopback
from shared.telemetry.logs import configure_logging
from shared.telemetry.tracing import configure_tracing

if TYPE_CHECKING:
    from services.standalone import Standalone
    from shared.jobs.celery_wakeups import CeleryWakeups


def serve() -> None:
    """Serve the embedded Placewise (HOST, PORT, PLACEWISE_HOME) until Ctrl-C.

    Where HOST is not loopback, every call needs a key: the first start makes and prints an
    admin's, and `placewise keys` makes others.
    """
    with report_errors(as_json=False):
        settings = read_settings()
        from services.standalone import run_standalone  # brings torch, as `connect` says

        configure_logging(settings, "embedded")
        with configure_tracing(settings, "embedded"), run_standalone(settings) as running:
            err_console.print(_startup_message(running, settings), soft_wrap=True)
            running.serve()


def _startup_message(running: Standalone, settings: Settings) -> str:
    command, url = sys.argv[0], running.url
    header = '-H "Authorization: Bearer $PLACEWISE_KEY" ' if running.local_key else ""
    lines = [
        f"Placewise serves {settings.placewise_home} on {url}",
        *_key_instructions(running, settings, command),
        f"  look:     {url}   (the page)   {url}/docs   (the API)",
        (
            f"  put in:   curl {header}-F file=@PHOTO.jpg -F latitude=45.07 -F longitude=7.69 "
            f"{url}/api/v1/upload"
        ),
        (
            f"  ask:      curl {header}-F file=@OTHER.jpg -H 'Prefer: wait=30' "
            f"{url}/api/v1/similarity"
        ),
        f"  a folder: {command} index DIR, then {command} query PHOTO",
    ]
    return "\n".join(lines)


def _key_instructions(running: Standalone, settings: Settings, command: str) -> list[str]:
    if running.local_key is None:
        return []
    lines = []
    if not is_loopback(settings.host):
        lines.append(f"  open to:  whoever reaches {settings.host} and has a key")
    if running.first_admin_key is not None:
        lines.append(f"  key:      export PLACEWISE_KEY={running.first_admin_key}")
        lines.append("            It is shown this once; every call needs one.")
    elif settings.admin_key is not None:
        lines.append("  key:      the one in ADMIN_KEY, or one of placewise keys list")
    else:
        lines.append("  key:      one that was shown when it was made: placewise keys list")
        lines.append(f"            Lost it? {command} keys create NAME --scope admin")
    return lines


def search() -> None:
    """Answer searches over HTTP (HOST, PORT) for the part of the maps that SEARCH_SHARD names.

    DATABASE_URL is the catalog that it follows. It asks for no key: let only the gateway and the
    steward reach it, which find it by SEARCH_URLS.
    """
    with report_errors(as_json=False):
        settings = read_settings()
        # Imported only here: the other commands need no server.
        from services.search.service import run_search_service
        from shared.catalog.installation import open_installation_store
        from shared.catalog.schema import wait_for_schema
        from shared.catalog.tables import open_catalog

        configure_logging(settings, "search")
        catalog = open_catalog(settings, "search")
        try:
            wait_for_schema(catalog, settings.schema_wait_seconds)
            store = open_installation_store(
                catalog, settings, exclusive=False
            )  # others write there meanwhile
            with (
                configure_tracing(settings, "search"),
                run_search_service(settings, catalog, store) as running,
            ):
                err_console.print(
                    f"Placewise search serves shard {settings.shard} on {running.url}\n"
                    f"  look:     {running.url}/readyz   {running.url}/metrics",
                    soft_wrap=True,
                )
                running.serve()
        finally:
            catalog.close()


def gateway() -> None:
    """Answer the HTTP API (HOST, PORT). Every call needs a key: ADMIN_KEY, or one of `placewise
    keys`."""
    with _service_context("gateway") as (settings, catalog):
        from services.gateway.app import create_app
        from services.gateway.authentication import ApiKeyAuthenticator
        from services.gateway.dependencies import GatewayContext
        from services.http_server import http_server, listen, reachable_url, stop_on_signals
        from shared.telemetry.metrics_server import serve_metrics

        with (
            listen(settings.host, settings.port) as listener,
            _open_hints(settings) as hints,
            _search_client(settings) as search,
        ):
            url = reachable_url(*listener.getsockname()[:2])
            admins = _admin_key_hashes(settings, catalog)
            with catalog.write() as session:
                get_or_create_default_map(session, settings.new_map_extractor)
            store = open_installation_store(catalog, settings, exclusive=False)
            requests = catalog.with_timeouts(TransactionTimeouts.for_requests(settings))
            keys = ApiKeyAuthenticator(requests, *admins)
            context = GatewayContext(requests, store, hints, search, settings, keys)
            server = http_server(
                create_app(context),
                context.connections,
                on_stop=context.job_notifier.begin_shutdown,
            )
            err_console.print(f"Placewise gateway serves {url}", soft_wrap=True)
            with serve_metrics(settings, context.registry), stop_on_signals(server):
                server.run(sockets=[listener])


def extractor() -> None:
    """Describe photos: a Celery worker on REDIS_URL, DATABASE_URL and the object store."""
    with _service_context("extractor") as (settings, catalog):
        from services.extractor.service import serve_extractor  # brings torch

        serve_extractor(
            catalog,
            open_installation_store(catalog, settings, exclusive=False),
            settings,
            lambda: err_console.print("Placewise extractor is at work"),
        )


def steward() -> None:
    """Keep the store healthy, evaluate maps, bring in batches; any number of them may run."""
    with _service_context("steward") as (settings, catalog):
        from prometheus_client import CollectorRegistry

        from services.steward.batches.worker import BatchWorker
        from services.steward.evaluation_worker import EvaluationWorker
        from services.steward.metrics import StewardMetrics
        from services.steward.scheduler import Scheduler
        from services.steward.webhooks import WebhookDispatcher
        from shared.telemetry.metrics_server import serve_metrics

        stop, died = threading.Event(), threading.Event()

        def on_death() -> None:
            died.set()
            stop.set()

        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stop.set())
        with _open_hints(settings) as hints, _search_client(settings) as search:
            store = open_installation_store(catalog, settings, exclusive=False)
            name = f"steward-{socket.gethostname()}-{os.getpid()}"
            registry = CollectorRegistry()
            metrics = StewardMetrics(registry)
            batches = BatchWorker(catalog, store, hints, settings, name, metrics)
            duties = Scheduler(catalog, store, hints, settings, metrics)
            evaluator = EvaluationWorker(catalog, store, search, settings, name, metrics)
            webhooks = WebhookDispatcher(catalog, settings)
            parts = [
                start_service_thread("evaluator", evaluator.run, stop, on_death),
                start_service_thread("batches", batches.run, stop, on_death),
                start_service_thread("webhooks", webhooks.run, stop, on_death),
                start_service_thread("steward", duties.run, stop, on_death),
            ]
            err_console.print("Placewise steward is at work")
            with serve_metrics(settings, registry):
                for part in parts:
                    part.join()
        if died.is_set():
            raise Misconfigured("part_died", "A part of the steward died; the log above says why.")


def migrate() -> None:
    """Bring the catalog's tables up to date (DATABASE_URL): once per release, before its services
    start. Those of the release before go on meanwhile."""
    with report_errors(as_json=False):
        settings = read_settings()
        configure_logging(settings, "migrate")
        catalog = open_catalog(settings, "migrate")
        try:
            migrate_catalog(catalog)
            with catalog.write() as session:
                installation = get_or_create_installation(session)
        finally:
            catalog.close()
    err_console.print(f"The catalog's schema is up to date (installation {installation.id})")


@contextlib.contextmanager
def _service_context(name: str) -> Iterator[tuple[Settings, Catalog]]:
    """The settings, and the catalog, once its schema is the one that this release needs."""
    with report_errors(as_json=False):
        settings = read_settings()
        configure_logging(settings, name)
        with configure_tracing(settings, name):
            catalog = open_catalog(settings, name)
            try:
                wait_for_schema(catalog, settings.schema_wait_seconds)
                with process_heartbeat(catalog, name):
                    yield settings, catalog
            finally:
                catalog.close()


def _admin_key_hashes(settings: Settings, catalog: Catalog) -> list[str]:
    """Of ADMIN_KEY. Misconfigured (`admin_key_missing`) where nobody could make a call."""
    if settings.admin_key is not None:
        return [hash_api_key(settings.admin_key.get_secret_value())]
    with catalog.read() as session:
        if has_admin_key(session):
            return []
    raise Misconfigured(
        "admin_key_missing",
        "Every call needs a key, and there is none that could make others. Make one (placewise "
        "keys create NAME --scope admin), or set ADMIN_KEY: openssl rand -hex 24",
    )


@contextlib.contextmanager
def _open_hints(settings: Settings) -> Iterator[CeleryWakeups]:
    from shared.jobs.celery_wakeups import CeleryWakeups, create_celery_app

    hints = CeleryWakeups(create_celery_app(settings), settings)
    try:
        yield hints
    finally:
        hints.close()


@contextlib.contextmanager
def _search_client(settings: Settings) -> Iterator[HttpSearchClient]:
    if not settings.search_worker_urls:
        raise Misconfigured(
            "search_missing",
            "SEARCH_URLS is not set: name every search worker (placewise search), for example "
            "http://search-1:8000,http://search-2:8000.",
        )
    with HttpSearchClient(settings.search_worker_urls, settings.search_timeout_seconds) as search:
        yield search
