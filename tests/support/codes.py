"""Search by codes on maps that are far too small for it."""

from __future__ import annotations

import pytest

from services.search import answer, follow


def always_by_codes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every search of more than nothing goes through the codes, whatever its size."""
    monkeypatch.setattr(follow, "CODED_FROM_BYTES", 0)
    monkeypatch.setattr(follow, "CODED_DIMENSION", 1)
    monkeypatch.setattr(answer, "worth_codes", lambda selected, k: selected > 0)
