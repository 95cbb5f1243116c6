"""Locks by id, which one process at a time holds and which end with it."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from uuid import UUID

from shared.catalog.database.session import Catalog

POLL_SECONDS = 0.05

# SQLite is written by one process only.
_OF_THIS_PROCESS: defaultdict[UUID, threading.Lock] = defaultdict(threading.Lock)


@contextlib.contextmanager
def hold_lock(catalog: Catalog, key: UUID, wait_seconds: float) -> Iterator[bool]:
    """Hold the lock of `key` in the block; yields whether it was free within `wait_seconds`.

    PostgreSQL keeps an advisory lock for the connection and releases it when the process ends, not
    for a transaction, which must not be idle for long.
    """
    if catalog.is_sqlite:
        lock = _OF_THIS_PROCESS[key]
        owned = lock.acquire(timeout=wait_seconds)
        try:
            yield owned
        finally:
            if owned:
                lock.release()
        return
    number = key.int % 2**63
    with contextlib.closing(catalog.engine.raw_connection()) as connection:
        cursor = connection.cursor()
        ends_at = time.monotonic() + wait_seconds
        while True:
            cursor.execute("SELECT pg_try_advisory_lock(%s)", (number,))
            owned = cursor.fetchone() == (True,)
            if owned or time.monotonic() >= ends_at:
                break
            time.sleep(POLL_SECONDS)
        try:
            yield owned
        finally:
            if owned:
                try:
                    cursor.execute("SELECT pg_advisory_unlock(%s)", (number,))
                except BaseException:
                    connection.invalidate()  # closing it releases the lock
                    raise
