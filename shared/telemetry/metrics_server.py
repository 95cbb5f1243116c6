"""The metrics server on METRICS_PORT: `GET /metrics` without a key, for services without HTTP."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator

from prometheus_client import CollectorRegistry, start_http_server

from shared.config.settings import Settings
from shared.errors import Misconfigured

log = logging.getLogger(__name__)

METRICS_CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
"""Content type of Prometheus' text format."""


@contextlib.contextmanager
def serve_metrics(settings: Settings, registry: CollectorRegistry) -> Iterator[int | None]:
    """Serve the registry's metrics on HOST and METRICS_PORT in a thread while the block runs.

    Yields:
        The port; None where METRICS_PORT is not set.

    Raises:
        Misconfigured: `address_in_use`.
    """
    if settings.metrics_port is None:
        yield None
        return
    try:
        server, thread = start_http_server(
            settings.metrics_port, addr=settings.host, registry=registry
        )
    except OSError as error:
        raise Misconfigured(
            "address_in_use",
            f"Can't listen on {settings.host}:{settings.metrics_port} (METRICS_PORT): "
            f"{error.strerror or error}. Choose another port.",
        ) from error
    log.info("serving metrics on port %d", server.server_port)
    try:
        yield server.server_port
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
