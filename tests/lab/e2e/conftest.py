"""One `placewise serve` per module, as in `tests/e2e`."""

from tests.e2e.conftest import server

__all__ = ["server"]
