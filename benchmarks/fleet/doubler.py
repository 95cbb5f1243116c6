"""Delivers every Celery message twice, as Redis may after a lost acknowledgement."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator

from redis import Redis
from redis.exceptions import RedisError

from shared.jobs.hints import WakeupQueue


class MessageDuplicator:
    """Watches Redis and pushes each message of a lane once more. `doubled` counts them."""

    def __init__(self, url: str) -> None:
        self._url = url
        self.duplicated_messages = 0

    @contextlib.contextmanager
    def duplicating(self) -> Iterator[None]:
        with (
            Redis.from_url(self._url) as watching,
            Redis.from_url(self._url) as pushing,
            watching.monitor() as monitor,
        ):
            own_port = pushing.client_info()["addr"].rpartition(":")[2]
            stop = threading.Event()
            watcher = threading.Thread(
                target=self._watch, args=(monitor, pushing, own_port, stop), daemon=True
            )
            watcher.start()
            try:
                yield
            finally:
                stop.set()
                pushing.ping()  # the next thing that the watcher sees
                watcher.join(timeout=5)

    def _watch(self, monitor, pushing: Redis, own_port: str, stop: threading.Event) -> None:  # type: ignore[no-untyped-def]
        with contextlib.suppress(RedisError, ValueError):
            for seen in monitor.listen():
                if stop.is_set():
                    return
                words = seen["command"].split(" ", 2)
                if words[0] != "LPUSH" or words[1] not in set(WakeupQueue):
                    continue
                if seen["client_port"] == own_port:
                    continue
                # A waiting message as it lies there: MONITOR's own text is quoted.
                message = pushing.lindex(words[1], 0)
                if message is not None:
                    pushing.lpush(words[1], message)
                    self.duplicated_messages += 1
