"""Gateway service process: the HTTP API, with wakeups through Redis and search over HTTP."""

from __future__ import annotations

import contextlib

from services.gateway.app import create_app
from services.gateway.authentication import ApiKeyAuthenticator
from services.gateway.dependencies import GatewayContext
from services.gateway.proxy_sign_in import with_proxy_sign_in
from services.http_server import http_server, listen, reachable_url, stop_on_signals
from services.service_process import Announce, service_process
from shared.catalog.api_keys import has_admin_key
from shared.catalog.database.session import REQUEST_TIMEOUTS, Catalog
from shared.catalog.installation import open_installation_store
from shared.catalog.maps import get_or_create_default_map
from shared.catalog.processes import process_heartbeat
from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.jobs.celery_messages import CeleryJobMessages, create_celery_app
from shared.search_api.client import HttpSearchClient
from shared.security.api_keys import hash_api_key
from shared.telemetry.metrics_server import serve_metrics


def serve_gateway(settings: Settings, announce: Announce) -> None:
    """Serve the HTTP API on HOST and PORT until SIGTERM.

    Raises:
        Misconfigured: `admin_key_missing`, `search_missing`, `redis_missing`, `address_in_use`.
    """
    with (
        service_process(settings, "gateway") as catalog,
        process_heartbeat(catalog, "gateway"),
        listen(settings.host, settings.port) as listener,
        contextlib.closing(CeleryJobMessages(create_celery_app(settings), settings)) as wakeups,
        HttpSearchClient.from_settings(settings) as search,
    ):
        url = reachable_url(*listener.getsockname()[:2])
        admin_key_hashes = _admin_key_hashes(settings, catalog)
        with catalog.write() as session:
            get_or_create_default_map(session, settings.new_map_extractor, settings.descriptor_rows)
        store = open_installation_store(catalog, settings, exclusive=False)
        requests = catalog.with_timeouts(REQUEST_TIMEOUTS)
        keys = ApiKeyAuthenticator(requests, *admin_key_hashes)
        authenticator = with_proxy_sign_in(keys, settings)
        context = GatewayContext(requests, store, wakeups, search, settings, authenticator)
        server = http_server(
            create_app(context), context.connections, on_stop=context.job_notifier.begin_shutdown
        )
        with serve_metrics(settings, context.registry), stop_on_signals(server):
            announce(f"Placewise gateway serves {url}")
            server.run(sockets=[listener])


def _admin_key_hashes(settings: Settings, catalog: Catalog) -> list[str]:
    """The hash of ADMIN_KEY, if set; Misconfigured (`admin_key_missing`) without any admin key."""
    if settings.admin_key is not None:
        return [hash_api_key(settings.admin_key.get_secret_value())]
    with catalog.read() as session:
        if has_admin_key(session):
            return []
    raise Misconfigured(
        "admin_key_missing",
        "Every call requires a key, but no admin key exists. Set ADMIN_KEY (generate it with "
        "openssl rand -hex 24).",
    )
