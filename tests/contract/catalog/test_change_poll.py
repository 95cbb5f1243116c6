"""Loops look at the catalog again after a commit, and seldom without one."""

from __future__ import annotations

import threading
import time

import pytest

from shared.catalog.database import session as session_module
from shared.catalog.database.session import Catalog, ChangePoll
from tests.support.catalog_rows import add_map


@pytest.fixture(autouse=True)
def check_for_stop_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session_module, "STOP_CHECK_SECONDS", 0.01)


def test_commit_ends_the_wait_and_is_seen_once(catalog: Catalog) -> None:
    poll, stop = ChangePoll(catalog), threading.Event()
    poll.wait(stop, 0.0, 0.0)  # after the first look
    with catalog.write() as session:
        add_map(session)
    started = time.monotonic()
    poll.wait(stop, 0.0, 60.0)
    assert time.monotonic() - started < 30.0
    if catalog.is_sqlite:
        poll.wait(stop, 0.0, 0.5)
        assert time.monotonic() - started > 0.4


def test_commit_without_changes_and_heartbeat_end_no_wait(catalog: Catalog) -> None:
    count = catalog.commits.count
    with catalog.write():
        pass
    with catalog.write(is_heartbeat=True) as session:
        add_map(session)
    assert catalog.commits.count == count


def test_a_loop_that_waits_by_itself_looks_after_a_commit_and_seldom_without(
    catalog: Catalog,
) -> None:
    poll = ChangePoll(catalog)
    assert poll.is_due(60.0), "the first look"
    assert poll.is_due(60.0) is not catalog.is_sqlite
    with catalog.write() as session:
        add_map(session)
    assert poll.is_due(0.0)
    assert poll.is_due(60.0), "the interval has passed since the last poll"


def test_stop_ends_the_wait(catalog: Catalog) -> None:
    poll, stop = ChangePoll(catalog), threading.Event()
    poll.wait(stop, 0.0, 0.0)
    waiting = threading.Thread(target=poll.wait, args=(stop, 0.0, 60.0))
    waiting.start()
    stop.set()
    waiting.join(timeout=30)
    assert not waiting.is_alive()
