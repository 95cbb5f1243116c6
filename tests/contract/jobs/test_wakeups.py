"""Wakeups between threads of one process."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

from shared.jobs import (
    InProcessWakeups,
)


def test_a_hint_sent_before_the_wait_is_not_lost() -> None:
    hints = InProcessWakeups()
    hints.send()
    assert hints.wait(30)


def test_at_most_one_hint_is_outstanding() -> None:
    hints = InProcessWakeups()
    for _ in range(5):
        hints.send()
    assert hints.wait(30)
    assert not hints.wait(0)


def test_a_waiting_worker_wakes_with_the_hint() -> None:
    hints = InProcessWakeups()
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(hints.wait, 60)
        hints.send()
        assert waiting.result(timeout=30)


def test_a_wait_without_a_hint_ends() -> None:
    assert not InProcessWakeups().wait(0.01)
