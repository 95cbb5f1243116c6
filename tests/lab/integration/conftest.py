"""The service in process, as in `tests/integration`."""

from tests.integration.conftest import decoders, make_worker, service

__all__ = ["decoders", "make_worker", "service"]
