"""Search by codes on maps that are far too small for it."""

from __future__ import annotations

import pytest

from services.search import catalog_sync, executor


def always_by_codes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every search of more than nothing goes through the codes, whatever its size."""
    monkeypatch.setattr(catalog_sync, "MIN_CODED_BYTES", 0)
    monkeypatch.setattr(catalog_sync, "CODED_DIMENSION", 1)
    monkeypatch.setattr(executor, "sign_codes_pay_off", lambda selected, k: selected > 0)
