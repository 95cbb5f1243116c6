"""Extractors and services in the process of the test, as in `tests/integration`."""

from tests.integration.conftest import decoders, make_worker, service, sqlite_catalog

__all__ = ["decoders", "make_worker", "service", "sqlite_catalog"]
