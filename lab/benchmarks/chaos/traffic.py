"""Load on the fleet: uploads each photo until it is acknowledged, and sends queries."""

from __future__ import annotations

import contextlib
import hashlib
import random
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any, Self
from uuid import UUID

import httpx2

from tests.support.photos import photo_bytes
from tests.support.server import SERVICES_KEY

UPLOADERS = 4
CALL_TIMEOUT_SECONDS = 60.0
RETRY_SECONDS = 0.1
MIN_SELF_SCORE = 0.9999
RETRYABLE_STATUSES = (429, 503, 507)


class Traffic:
    """Uploads the photos 0, 1, 2 ... as they are released, and queries with the searchable ones.

    A failed call is retried at the next gateway.
    """

    def __init__(self, urls: Sequence[str], seed: int, query_interval_seconds: float) -> None:
        self._query_interval_seconds = query_interval_seconds
        self._random = random.Random(seed)
        headers = {"Authorization": f"Bearer {SERVICES_KEY}"}
        self._clients = [
            httpx2.Client(base_url=url, headers=headers, timeout=CALL_TIMEOUT_SECONDS)
            for url in urls
        ]
        self._lock = threading.Lock()
        self._released = 0
        self._next = 0
        self._stop = threading.Event()
        self._querying = threading.Lock()
        self._numbers: dict[UUID, int] = {}
        self.acknowledged: dict[str, UUID] = {}
        self.known: list[int] = []
        """Numbers of photos that every result must contain."""
        self.answers: Counter[str] = Counter()
        """How calls went: `acknowledged`, `right`, `wrong`, `unexpected`, `retried`."""
        self.details: list[str] = []
        self._threads = [
            threading.Thread(target=self._upload, args=(caller,), name="uploader", daemon=True)
            for caller in range(UPLOADERS)
        ]
        self._threads.append(threading.Thread(target=self._query_loop, name="querier", daemon=True))

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()
        for client in self._clients:
            client.close()

    def release(self, photos: int) -> None:
        """Allow this total number of photos to be uploaded."""
        self._released = photos

    @property
    def all_acknowledged(self) -> bool:
        return len(self.acknowledged) >= self._released

    def mark_searchable(self) -> None:
        """Require from now on that each result contains the acknowledged photos."""
        with self._lock:
            self.known = sorted(self._numbers.values())

    @contextlib.contextmanager
    def pause_queries(self) -> Iterator[None]:
        """Context manager during which no query is in progress."""
        with self._querying:
            yield

    def _upload(self, caller: int) -> None:
        while not self._stop.is_set():
            with self._lock:
                number = self._next if self._next < self._released else None
                if number is not None:
                    self._next += 1
            if number is None:
                self._stop.wait(0.02)
                continue
            data = photo_bytes(number)
            tries = caller
            while not self._stop.is_set():
                body = self._call(
                    tries, "/api/v1/upload", (200, 202), files={"file": (f"{number}.jpg", data)}
                )
                if body is not None:
                    photo_id = UUID(body["file_id"])
                    with self._lock:
                        self.acknowledged[hashlib.sha256(data).hexdigest()] = photo_id
                        self._numbers[photo_id] = number
                    self.answers["acknowledged"] += 1
                    break
                tries += 1
                self._stop.wait(RETRY_SECONDS)

    def _query_loop(self) -> None:
        while not self._stop.wait(self._query_interval_seconds):
            with self._lock:
                number = self._random.choice(self.known) if self.known else None
            if number is not None:
                with self._querying:
                    self.query(number)

    def query(self, number: int) -> None:
        """Query with the bytes of an acknowledged photo and check the result."""
        body = self._call(
            self._random.randrange(len(self._clients)),
            "/api/v1/similarity",
            (200, 202),
            files={"file": ("query.jpg", photo_bytes(number))},
            params={"top_k": 5},
            headers={"Prefer": "wait=10"},
        )
        if body is None or "similar_images" not in body or body["missing"]:
            return  # retried, not ready in time, or a shard is missing
        found = body["similar_images"]
        ids = [photo["image_id"] for photo in found]
        right = (
            bool(found)
            and self._numbers.get(UUID(ids[0])) == number
            and found[0]["similarity_score"] > MIN_SELF_SCORE
            and len(set(ids)) == len(ids)
        )
        self.answers["right" if right else "wrong"] += 1
        if not right:
            self.details.append(f"query with photo {number}: {found[:2]}")

    def _call(
        self, caller: int, path: str, expected: Sequence[int], **options: Any
    ) -> dict[str, Any] | None:
        """Return the response body; None if the caller should retry."""
        number = caller % len(self._clients)
        started_at = time.monotonic()
        try:
            answer = self._clients[number].post(path, **options)
        except httpx2.TransportError as error:
            self.answers["retried"] += 1
            if isinstance(error, httpx2.ReadTimeout):
                self.answers["unexpected"] += 1
                seconds = time.monotonic() - started_at
                self.details.append(f"{path} did not answer in {seconds:.0f} s")
            return None
        if answer.status_code in expected:
            body: dict[str, Any] = answer.json()
            return body
        if answer.status_code in RETRYABLE_STATUSES:
            self.answers["retried"] += 1
        else:
            self.answers["unexpected"] += 1
            self.details.append(f"{path} answered {answer.status_code}: {answer.text[:500]}")
        return None
