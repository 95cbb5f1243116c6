"""Values that are polled at most once per interval."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from shared.jobs.queue_depth import PolledValue


@pytest.fixture
def no_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Polls are due again after the interval, however long they take."""
    monkeypatch.setattr("shared.jobs.queue_depth.POLL_COST_DIVISOR", 0.0)


@pytest.mark.usefixtures("no_cost")
def test_a_value_is_polled_once_per_interval() -> None:
    polls = iter(range(9))
    value = PolledValue(lambda: next(polls), 3600.0)
    assert [value.get() for _ in range(3)] == [0, 0, 0]
    always = PolledValue(lambda: next(polls), 0.0)
    assert [always.get() for _ in range(3)] == [1, 2, 3]


def test_a_failed_poll_raises_and_is_repeated() -> None:
    results: Iterator[int | ZeroDivisionError] = iter([ZeroDivisionError(), 7])

    def poll() -> int:
        result = next(results)
        if isinstance(result, ZeroDivisionError):
            raise result
        return result

    value = PolledValue(poll, 3600.0)
    with pytest.raises(ZeroDivisionError):
        value.get()
    assert [value.get(), value.get()] == [7, 7]


@pytest.mark.usefixtures("no_cost")
def test_the_previous_value_is_used_while_another_thread_polls() -> None:
    polling, go_on = threading.Event(), threading.Event()
    first = iter([True])

    def poll() -> str:
        if next(first, False):
            return "previous"
        polling.set()
        assert go_on.wait(60)
        return "new"

    value = PolledValue(poll, 0.0)
    assert value.get() == "previous"
    with ThreadPoolExecutor(1) as other:
        new = other.submit(value.get)
        assert polling.wait(60)
        assert value.get() == "previous"
        go_on.set()
        assert new.result() == "new"
