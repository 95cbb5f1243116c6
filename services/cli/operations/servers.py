"""Commands that run servers: `serve`, `gateway`, `extractor`, `search`, `steward`, and `migrate`.

`serve` runs the embedded Placewise in one process. The others run one service each; services share
DATABASE_URL (PostgreSQL), REDIS_URL, the object store and SEARCH_URLS. Modules that only one
service needs are imported inside its function, because each service has an image with its own
packages.
"""

from __future__ import annotations

import contextlib
import os
import shlex
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
    """Run the embedded Placewise (HOST, PORT, PLACEWISE_HOME) until Ctrl-C.

    If HOST is not a loopback address, every call requires an API key. The first start creates and
    prints an admin key; `placewise keys` creates others.
    """
    with report_errors(as_json=False):
        settings = read_settings()
        from services.standalone import run_standalone

        configure_logging(settings, "embedded")
        with configure_tracing(settings, "embedded"), run_standalone(settings) as running:
            err_console.print(_startup_message(running, settings), soft_wrap=True)
            running.serve()


def _startup_message(running: Standalone, settings: Settings) -> str:
    # Complete: without its folder, a command of another shell would start a second Placewise.
    command = f"PLACEWISE_HOME={shlex.quote(str(settings.placewise_home))} {sys.argv[0]}"
    url = running.url
    header = '-H "Authorization: Bearer $PLACEWISE_KEY" ' if running.local_key else ""
    lines = [
        f"Placewise serves {settings.placewise_home} on {url}",
        *_key_instructions(running, settings, command),
        f"  open:     {url}   (console)   {url}/docs   (API reference)",
        (
            f"  upload:   curl {header}-F file=@PHOTO.jpg -F latitude=45.07 -F longitude=7.69 "
            f"{url}/api/v1/upload"
        ),
        (
            f"  query:    curl {header}-F file=@OTHER.jpg -H 'Prefer: wait=30' "
            f"{url}/api/v1/similarity"
        ),
        f"  folder:   {command} index DIR",
        f"            {command} query PHOTO",
    ]
    return "\n".join(lines)


def _key_instructions(running: Standalone, settings: Settings, command: str) -> list[str]:
    if running.local_key is None:
        return []
    lines = []
    if not is_loopback(settings.host):
        lines.append(f"  access:   anyone who can reach {settings.host} and has a key")
    if running.first_admin_key is not None:
        lines.append(f"  key:      export PLACEWISE_KEY={running.first_admin_key}")
        lines.append("            It is shown only once. Every call requires a key.")
    elif settings.admin_key is not None:
        lines.append(f"  key:      ADMIN_KEY, or one of those listed by {command} keys list")
    else:
        lines.append(f"  key:      one of those listed by {command} keys list")
        lines.append(f"            To create one: {command} keys create NAME --scope admin")
    return lines


def search() -> None:
    """Run a search worker (HOST, PORT) for the shard of all maps given by SEARCH_SHARD.

    The worker follows the catalog at DATABASE_URL. It requires no key: allow access only from the
    gateway and the steward, which find it through SEARCH_URLS.
    """
    with report_errors(as_json=False):
        settings = read_settings()
        from services.search.service import run_search_service

        configure_logging(settings, "search")
        catalog = open_catalog(settings, "search")
        try:
            wait_for_schema(catalog, settings.schema_wait_seconds)
            store = open_installation_store(catalog, settings, exclusive=False)
            with (
                configure_tracing(settings, "search"),
                run_search_service(settings, catalog, store) as running,
            ):
                err_console.print(
                    f"Placewise search serves shard {settings.shard} on {running.url}\n"
                    f"  health:   {running.url}/readyz   {running.url}/metrics",
                    soft_wrap=True,
                )
                running.serve()
        finally:
            catalog.close()


def gateway() -> None:
    """Run the HTTP API (HOST, PORT).

    Every call requires an API key: ADMIN_KEY, or one created with `placewise keys`.
    """
    with _service_context("gateway") as (settings, catalog):
        from services.gateway.app import create_app
        from services.gateway.authentication import ApiKeyAuthenticator
        from services.gateway.dependencies import GatewayContext
        from services.gateway.proxy_sign_in import with_proxy_sign_in
        from services.http_server import http_server, listen, reachable_url, stop_on_signals
        from shared.telemetry.metrics_server import serve_metrics

        with (
            listen(settings.host, settings.port) as listener,
            _open_wakeups(settings) as wakeups,
            _search_client(settings) as search,
        ):
            url = reachable_url(*listener.getsockname()[:2])
            admin_key_hashes = _admin_key_hashes(settings, catalog)
            with catalog.write() as session:
                get_or_create_default_map(session, settings.new_map_extractor)
            store = open_installation_store(catalog, settings, exclusive=False)
            requests = catalog.with_timeouts(TransactionTimeouts.for_requests(settings))
            keys = with_proxy_sign_in(ApiKeyAuthenticator(requests, *admin_key_hashes), settings)
            context = GatewayContext(requests, store, wakeups, search, settings, keys)
            server = http_server(
                create_app(context),
                context.connections,
                on_stop=context.job_notifier.begin_shutdown,
            )
            err_console.print(f"Placewise gateway serves {url}", soft_wrap=True)
            with serve_metrics(settings, context.registry), stop_on_signals(server):
                server.run(sockets=[listener])


def extractor() -> None:
    """Run an extractor, which computes descriptors of photos.

    It is a Celery worker on REDIS_URL, DATABASE_URL and the object store.
    """
    with _service_context("extractor") as (settings, catalog):
        from services.extractor.service import serve_extractor  # imports torch

        serve_extractor(
            catalog,
            open_installation_store(catalog, settings, exclusive=False),
            settings,
            lambda: err_console.print("Placewise extractor is running"),
        )


def steward() -> None:
    """Run a steward: maintenance, evaluations, batch uploads and webhooks.

    Any number of stewards can run at the same time.
    """
    with _service_context("steward") as (settings, catalog):
        from prometheus_client import CollectorRegistry

        from services.steward.batches.worker import BatchWorker
        from services.steward.evaluation_worker import EvaluationWorker
        from services.steward.metrics import StewardMetrics
        from services.steward.scheduler import Scheduler
        from services.steward.webhooks import WebhookDispatcher
        from shared.telemetry.metrics_server import serve_metrics

        stop, failed = threading.Event(), threading.Event()

        def on_failure() -> None:
            failed.set()
            stop.set()

        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stop.set())
        with _open_wakeups(settings) as wakeups, _search_client(settings) as search:
            store = open_installation_store(catalog, settings, exclusive=False)
            name = f"steward-{socket.gethostname()}-{os.getpid()}"
            registry = CollectorRegistry()
            metrics = StewardMetrics(registry)
            batches = BatchWorker(catalog, store, wakeups, settings, name, metrics)
            scheduler = Scheduler(catalog, store, wakeups, settings, metrics)
            evaluator = EvaluationWorker(catalog, store, search, settings, name, metrics)
            webhooks = WebhookDispatcher(catalog, settings)
            threads = [
                start_service_thread("evaluator", evaluator.run, stop, on_failure),
                start_service_thread("batches", batches.run, stop, on_failure),
                start_service_thread("webhooks", webhooks.run, stop, on_failure),
                start_service_thread("steward", scheduler.run, stop, on_failure),
            ]
            err_console.print("Placewise steward is running")
            with serve_metrics(settings, registry):
                for thread in threads:
                    thread.join()
        if failed.is_set():
            raise Misconfigured("part_died", "A thread of the steward failed. See the log above.")


def migrate() -> None:
    """Migrate the catalog's schema (DATABASE_URL) to this release.

    Run it once per release, before the new services start. Services of the previous release keep
    working during the migration.
    """
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
    """Set up logging, tracing and heartbeat, and open the catalog once its schema is current."""
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
    """The hash of ADMIN_KEY, if set; Misconfigured (`admin_key_missing`) without any admin key."""
    if settings.admin_key is not None:
        return [hash_api_key(settings.admin_key.get_secret_value())]
    with catalog.read() as session:
        if has_admin_key(session):
            return []
    raise Misconfigured(
        "admin_key_missing",
        "Every call requires a key, but no admin key exists. Create one (placewise keys create "
        "NAME --scope admin), or set ADMIN_KEY (generate it with openssl rand -hex 24).",
    )


@contextlib.contextmanager
def _open_wakeups(settings: Settings) -> Iterator[CeleryWakeups]:
    from shared.jobs.celery_wakeups import CeleryWakeups, create_celery_app

    wakeups = CeleryWakeups(create_celery_app(settings), settings)
    try:
        yield wakeups
    finally:
        wakeups.close()


@contextlib.contextmanager
def _search_client(settings: Settings) -> Iterator[HttpSearchClient]:
    if not settings.search_worker_urls:
        raise Misconfigured(
            "search_missing",
            "SEARCH_URLS is not set. List the URL of every search worker, for example "
            "http://search-1:8000,http://search-2:8000.",
        )
    with HttpSearchClient(settings.search_worker_urls, settings.search_timeout_seconds) as search:
        yield search
