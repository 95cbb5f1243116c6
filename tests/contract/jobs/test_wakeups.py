"""Wakeups between threads of one process."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

from shared.jobs import InProcessWakeups


def test_a_wakeup_sent_before_the_wait_is_not_lost_and_at_most_one_is_outstanding() -> None:
    wakeups = InProcessWakeups()
    for _ in range(5):
        wakeups.send()
    assert wakeups.wait(30)
    assert not wakeups.wait(0.01)


def test_a_waiting_worker_is_woken() -> None:
    wakeups = InProcessWakeups()
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(wakeups.wait, 60)
        wakeups.send()
        assert waiting.result(timeout=30)
