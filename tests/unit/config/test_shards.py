"""Shards: every slot has one, and what is not a shard is refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from shared.config.settings import Settings
from shared.config.shards import SINGLE_SHARD, Shard, is_shard_name


@given(slot=st.integers(0, 10_000), of=st.integers(1, 50))
def test_every_slot_belongs_to_exactly_one_shard(slot: int, of: int) -> None:
    assert [Shard(index, of).owns(slot) for index in range(of)].count(True) == 1


def test_a_shard_round_trips_as_text() -> None:
    assert Shard.parse(" 2/3 ") == Shard(2, 3)
    assert str(Shard(2, 3)) == "2/3"
    assert Shard.parse("0/1") == SINGLE_SHARD


@pytest.mark.parametrize("text", ["", "3/3", "-1/3", "1", "1/0", "a/b", "1/2/3", "0.5/2"])
def test_malformed_shards_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is not a shard"):
        Shard.parse(text)


def test_a_missing_shard_differs_from_a_missing_object() -> None:
    assert is_shard_name(Shard(1, 3).name)
    assert not is_shard_name("chunks/a/b.npy")


def test_settings_name_a_shard_and_its_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    assert (Settings().shard, Settings().search_worker_urls) == (SINGLE_SHARD, ())
    monkeypatch.setenv("SEARCH_SHARD", "1/3")
    monkeypatch.setenv("SEARCH_URLS", "http://a:8000/, https://b:1 http://a:8000")
    settings = Settings()
    assert settings.shard == Shard(1, 3)
    assert settings.search_worker_urls == ("http://a:8000", "https://b:1")


@pytest.mark.parametrize(
    ("name", "value"),
    [("SEARCH_SHARD", "3/3"), ("SEARCH_URLS", "search-0:8000"), ("SEARCH_URLS", "http://a/b")],
)
def test_invalid_settings_of_search_are_named(
    monkeypatch: pytest.MonkeyPatch, name: str, value: str
) -> None:
    monkeypatch.setenv(name, value)
    with pytest.raises(ValidationError, match=name.lower()):
        Settings()
