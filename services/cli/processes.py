"""`placewise gateway|extractor|steward`: services in processes of their own (`search` is beside).

They share DATABASE_URL (PostgreSQL), REDIS_URL, the object store, and SEARCH_URLS. What only one of
them needs is imported there: each has an image of its own, with its own packages.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import threading
from collections.abc import Iterator
from typing import TYPE_CHECKING

from services.cli.configuration import read_settings
from services.cli.output import explained, messages
from services.parts import start_part
from shared.api_keys import hash_key
from shared.catalog.connections import Limits
from shared.catalog.installation import ensure_installation, open_own_store
from shared.catalog.keys import has_admin_key
from shared.catalog.live_processes import signs_of_life
from shared.catalog.maps import ensure_default_map
from shared.catalog.open_catalog import open_catalog
from shared.catalog.schema import migrate as migrate_catalog
from shared.catalog.schema import wait_for_schema
from shared.catalog.session import Catalog
from shared.errors import Misconfigured
from shared.search_http import HttpSearch
from shared.settings import Settings
from shared.telemetry.logs import set_up_logs
from shared.telemetry.traces import set_up_traces

if TYPE_CHECKING:
    from shared.jobs.celery_hints import CeleryHints


def gateway() -> None:
    """Answer the HTTP API (HOST, PORT). Every call needs a key: ADMIN_KEY, or one of `placewise
    keys`."""
    with _service("gateway") as (settings, catalog):
        from services.gateway.app import create_app
        from services.gateway.context import Gateway
        from services.gateway.keys import CatalogKeys
        from services.http_server import http_server, listening, stopped_by_signals, url_of
        from shared.telemetry.metrics_server import serving_metrics

        with (
            listening(settings.host, settings.port) as listener,
            _hints(settings) as hints,
            _search(settings) as search,
        ):
            url = url_of(*listener.getsockname()[:2])
            admins = _admin_hashes(settings, catalog)
            with catalog.write() as session:
                ensure_default_map(session, settings.new_map_extractor)
            store = open_own_store(catalog, settings, alone=False)
            requests = catalog.limited(Limits.of_requests(settings))
            keys = CatalogKeys(requests, *admins)
            context = Gateway(requests, store, hints, search, settings, keys)
            server = http_server(
                create_app(context), context.connections, on_stop=context.job_watch.end_soon
            )
            messages.print(f"Placewise gateway serves {url}", soft_wrap=True)
            with serving_metrics(settings, context.registry), stopped_by_signals(server):
                server.run(sockets=[listener])


def extractor() -> None:
    """Describe photos: a Celery worker on REDIS_URL, DATABASE_URL and the object store."""
    with _service("extractor") as (settings, catalog):
        from services.extractor.service import serve_extractor  # brings torch

        serve_extractor(
            catalog,
            open_own_store(catalog, settings, alone=False),
            settings,
            lambda: messages.print("Placewise extractor is at work"),
        )


def steward() -> None:
    """Keep the store healthy, evaluate maps, bring in batches; any number of them may run."""
    with _service("steward") as (settings, catalog):
        from prometheus_client import CollectorRegistry

        from services.steward.batches.worker import BatchWorker
        from services.steward.evaluate import Evaluator
        from services.steward.loop import Steward
        from services.steward.metrics import StewardMetrics
        from services.steward.webhooks.deliver import WebhookSender
        from shared.telemetry.metrics_server import serving_metrics

        stop, died = threading.Event(), threading.Event()

        def on_death() -> None:
            died.set()
            stop.set()

        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stop.set())
        with _hints(settings) as hints, _search(settings) as search:
            store = open_own_store(catalog, settings, alone=False)
            name = f"steward-{socket.gethostname()}-{os.getpid()}"
            registry = CollectorRegistry()
            metrics = StewardMetrics(registry)
            batches = BatchWorker(catalog, store, hints, settings, name, metrics)
            duties = Steward(catalog, store, hints, settings, metrics)
            evaluator = Evaluator(catalog, store, search, settings, name, metrics)
            webhooks = WebhookSender(catalog, settings)
            parts = [
                start_part("evaluator", evaluator.run, stop, on_death),
                start_part("batches", batches.run, stop, on_death),
                start_part("webhooks", webhooks.run, stop, on_death),
                start_part("steward", duties.run, stop, on_death),
            ]
            messages.print("Placewise steward is at work")
            with serving_metrics(settings, registry):
                for part in parts:
                    part.join()
        if died.is_set():
            raise Misconfigured("part_died", "A part of the steward died; the log above says why.")


def migrate() -> None:
    """Bring the catalog's tables up to date (DATABASE_URL): once per release, before its services
    start. Those of the release before go on meanwhile."""
    with explained(as_json=False):
        settings = read_settings()
        set_up_logs(settings, "migrate")
        catalog = open_catalog(settings, "migrate")
        try:
            migrate_catalog(catalog)
            with catalog.write() as session:
                installation = ensure_installation(session)
        finally:
            catalog.close()
    messages.print(f"The catalog's schema is up to date (installation {installation.id})")


@contextlib.contextmanager
def _service(name: str) -> Iterator[tuple[Settings, Catalog]]:
    """The settings, and the catalog, once its schema is the one that this release needs."""
    with explained(as_json=False):
        settings = read_settings()
        set_up_logs(settings, name)
        with set_up_traces(settings, name):
            catalog = open_catalog(settings, name)
            try:
                wait_for_schema(catalog, settings.schema_wait_seconds)
                with signs_of_life(catalog, name):
                    yield settings, catalog
            finally:
                catalog.close()


def _admin_hashes(settings: Settings, catalog: Catalog) -> list[str]:
    """Of ADMIN_KEY. Misconfigured (`admin_key_missing`) where nobody could make a call."""
    if settings.admin_key is not None:
        return [hash_key(settings.admin_key.get_secret_value())]
    with catalog.read() as session:
        if has_admin_key(session):
            return []
    raise Misconfigured(
        "admin_key_missing",
        "Every call needs a key, and there is none that could make others. Make one (placewise "
        "keys create NAME --scope admin), or set ADMIN_KEY: openssl rand -hex 24",
    )


@contextlib.contextmanager
def _hints(settings: Settings) -> Iterator[CeleryHints]:
    from shared.jobs.celery_app import make_celery
    from shared.jobs.celery_hints import CeleryHints

    hints = CeleryHints(make_celery(settings), settings)
    try:
        yield hints
    finally:
        hints.close()


@contextlib.contextmanager
def _search(settings: Settings) -> Iterator[HttpSearch]:
    if not settings.search_addresses:
        raise Misconfigured(
            "search_missing",
            "SEARCH_URLS is not set: name every search worker (placewise search), for example "
            "http://search-1:8000,http://search-2:8000.",
        )
    with HttpSearch(settings.search_addresses, settings.search_timeout_seconds) as search:
        yield search
