"""The small caches of what is costly to load."""

from __future__ import annotations

import pytest

from services.extractor.model_registry import LruCache


def test_value_that_was_used_least_lately_is_made_anew() -> None:
    made: list[str] = []
    kept: LruCache[str, str] = LruCache(2)

    def use(key: str) -> str:
        def make() -> str:
            made.append(key)
            return key.upper()

        return kept.get(key, make)

    assert [use(key) for key in "abaca"] == list("ABACA")
    assert made == ["a", "b", "c"], "a was used after b"
    assert set(kept.values()) == {"A", "C"}
    use("b")
    assert made == ["a", "b", "c", "b"]


def test_value_that_can_not_be_made_is_tried_again_and_displaces_nothing() -> None:
    kept: LruCache[str, int] = LruCache(1)
    kept.get("there", lambda: 1)
    with pytest.raises(ZeroDivisionError):
        kept.get("broken", lambda: 1 // 0)
    assert list(kept.values()) == [1]
    assert kept.get("broken", lambda: 2) == 2
