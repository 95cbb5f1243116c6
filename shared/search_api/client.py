"""The search port in front of many workers: one of each shard is asked, all shards at once.

One answer from the answers of the shards.

The search tier as its clients see it: one port in front of many workers.

`workers` keeps who serves which shard; `port` asks one worker of each shard at once; `merge` makes
one answer of theirs. One worker that holds everything is the case of a single shard.
"""

from __future__ import annotations

import heapq
import logging
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextvars import copy_context
from types import TracebackType
from typing import Self
from uuid import UUID

import httpx2

from shared.config.shards import Shard
from shared.errors import Unavailable
from shared.search_api.protocol import (
    CERTIFICATES,
    NONE,
    SearchHit,
    SearchRequest,
    SearchResponse,
    SearchStatus,
)
from shared.search_api.workers import (
    REFRESH_SECONDS,
    WorkerDirectory,
    WorkerUnavailable,
    call_search,
)

log = logging.getLogger(__name__)


def merge_responses(
    answers: Sequence[SearchResponse], k: int, unreachable: Iterable[Shard] = ()
) -> SearchResponse:
    """The first `k` hits of all, and what has to be known of the way to them: the sums, the least
    version, the weakest certificate. `unreachable` are the shards that are missing, and are
    named: of an
    answer that lacks anything, nothing is certain."""
    hits = _top_hits(k, answers)
    missing = (
        *(key for answer in answers for key in answer.missing),
        *(shard.name for shard in sorted(unreachable)),
    )
    weakest = max((answer.certificate for answer in answers), key=_certificate_rank)
    return SearchResponse(
        hits=tuple(hits),
        certified_k=0 if missing else _certified_count(hits, answers),
        max_z=max((answer.max_z for answer in answers if answer.max_z is not None), default=None),
        certificate=NONE if missing else weakest,
        rows_scanned=sum(answer.rows_scanned for answer in answers),
        rows_reranked=sum(answer.rows_reranked for answer in answers),
        snapshot_version=min(answer.snapshot_version for answer in answers),
        missing=missing,
    )


def _top_hits(k: int, answers: Sequence[SearchResponse]) -> list[SearchHit]:
    """Each answer's hits are sorted already: by what ranks them, best first, ties by photo id."""
    merged = heapq.merge(*(a.hits for a in answers), key=lambda hit: (-hit.ranked_by, hit.photo_id))
    found: dict[UUID, SearchHit] = {}
    for hit in merged:
        if len(found) == k:
            break
        # Two shards may be at two versions, between which a photo was described anew.
        found.setdefault(hit.photo_id, hit)
    return list(found.values())


def _certified_count(hits: Sequence[SearchHit], answers: Sequence[SearchResponse]) -> int:
    """How many of the first hits are certain: a shard that ended early vouches for what scores at
    least as high as the last hit that it is certain of itself."""
    sure = -1.0
    for answer in answers:
        if _certificate_rank(answer.certificate) >= CERTIFICATES.index(NONE):
            last = answer.certified_k - 1
            sure = max(sure, answer.hits[last].score if last >= 0 else 2.0)
    return sum(hit.score >= sure for hit in hits)


def _certificate_rank(certificate: str) -> int:
    """A name that this side does not know yet promises the least."""
    known = certificate in CERTIFICATES
    return CERTIFICATES.index(certificate) if known else len(CERTIFICATES)


def merge_statuses(
    shards: Mapping[Shard, SearchStatus], unreachable: Iterable[Shard] = ()
) -> SearchStatus:
    """What the shards hold together: a generation is there once every one of them has it."""
    found = list(shards.values())
    common = set.intersection(*(set(status.versions) for status in found)) if found else set()
    lagging = {key for status in found for key in status.lags}
    return SearchStatus(
        rows=sum(status.rows for status in found),
        resident_bytes=sum(status.resident_bytes for status in found),
        mapped_bytes=sum(status.mapped_bytes for status in found),
        versions={key: min(status.versions[key] for status in found) for key in common},
        incomplete=tuple(sorted({key for status in found for key in status.incomplete})),
        missing=tuple(key for status in found for key in status.missing),
        lags={
            key: max(
                (status.lags[key] for status in found if key in status.lags),
                key=lambda lag: lag.seconds,
            )
            for key in lagging
        },
        devices=tuple(device for status in found for device in status.devices),
        away=tuple(shard.name for shard in sorted(unreachable)),
    )


MAX_CONCURRENT_CALLS = 64  # to all shards together; more wait for their turn
RESPONSE_MARGIN_SECONDS = 0.2  # for a call that ends at the deadline to say why
RETRY_PAUSE_SECONDS = 0.05  # before workers that are behind are asked again

BEHIND, UNREADABLE = "search_behind", "chunk_unreadable"
RETRYABLE_CODES = (BEHIND, "codes_being_made")  # who refuses so may answer in a moment
PERMANENT_CODES = (UNREADABLE, "codes_not_made")


class HttpSearchClient:
    """Every search worker behind one port; a context manager.

    Of each shard one worker is asked, and the next one when that fails. A shard of which no worker
    answers in time is named in the answer's `missing`, and the rest is answered. Raises what the
    workers refuse with: Gone, NotFound, Unavailable (`chunk_unreadable`, `codes_being_made`,
    `codes_not_made`); Unavailable (`search_behind`) when no shard reaches `min_version` in time,
    and (`search_unavailable`) when no shard answers at all.
    """

    def __init__(self, urls: Sequence[str], timeout_seconds: float) -> None:
        self._timeout_seconds = timeout_seconds
        self._http = httpx2.Client(
            limits=httpx2.Limits(max_keepalive_connections=MAX_CONCURRENT_CALLS)
        )
        self._workers = WorkerDirectory(urls, self._http)
        self._calls = ThreadPoolExecutor(MAX_CONCURRENT_CALLS, thread_name_prefix="search-call")
        self._stop = threading.Event()
        self._following = threading.Thread(
            target=self._refresh_workers, name="search-workers", daemon=True
        )

    def __enter__(self) -> Self:
        self._workers.look()
        self._following.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stop.set()
        self._following.join()
        self._calls.shutdown(cancel_futures=True)
        self._workers.close()
        self._http.close()

    def _refresh_workers(self) -> None:
        while not self._stop.wait(REFRESH_SECONDS):
            self._workers.look()

    def search(self, request: SearchRequest) -> SearchResponse:
        deadline = time.monotonic() + self._timeout_seconds
        layout = self._workers.layout(request.generation_id, request.min_version)
        if not layout:  # no worker was ever seen
            self._workers.look()
            layout = self._workers.layout(request.generation_id, request.min_version)
        calls = {
            # In the request's context: its id and its trace go along.
            shard: self._calls.submit(
                copy_context().run, self._search_shard, shard, urls, request, deadline
            )
            for shard, urls in layout.items()
        }
        wait(calls.values(), timeout=deadline + RESPONSE_MARGIN_SECONDS - time.monotonic())
        answers, away, behind = _collect(calls)
        if not answers:
            raise behind or Unavailable(
                "search_unavailable", "No search worker answers. Ask again in a moment."
            )
        return merge_responses(answers, request.k, away)

    def status(self) -> SearchStatus:
        """Of the workers as they are now; Unavailable (`search_unavailable`) when all are away."""
        self._workers.look()
        found, away = self._workers.statuses()
        if not found:
            raise Unavailable("search_unavailable", "No search worker answers.")
        return merge_statuses(found, away)

    def _search_shard(
        self, shard: Shard, urls: Sequence[str], request: SearchRequest, deadline: float
    ) -> SearchResponse:
        """The answer of one of the shard's workers. Workers that are behind are asked again until
        the deadline; WorkerAway when there is none that answers."""
        behind: Unavailable | None = None
        while True:
            again = False
            unreadable: Unavailable | None = None
            # A lone worker has a second chance: the connection that was kept may have been stale.
            order = list(urls) if len(urls) != 1 else [urls[0], urls[0]]
            for place, url in enumerate(order):
                left = deadline - time.monotonic()
                if left <= 0:
                    break
                # Who is not the last to be asked may not take all the time that there is.
                seconds = left if url == order[-1] or place == len(order) - 1 else left / 2
                try:
                    return call_search(self._http, url, request, seconds)
                except WorkerUnavailable as error:
                    log.info(
                        "a call for %s failed, the next worker is asked: %s", shard.name, error
                    )
                    self._workers.failed(url)
                except Unavailable as error:
                    log.debug("%s: %s: %s", shard.name, url, error.detail)
                    if error.code in RETRYABLE_CODES:
                        behind, again = error, True
                    elif error.code in PERMANENT_CODES:
                        unreadable = error
            if unreadable is not None:
                raise unreadable  # no other worker could, and this one has the last word
            if not again or time.monotonic() + RETRY_PAUSE_SECONDS > deadline:
                # Who was behind and ran out of time at the next try is still behind.
                raise behind or WorkerUnavailable(shard.name, "no worker answers")
            time.sleep(RETRY_PAUSE_SECONDS)


def _collect(
    calls: dict[Shard, Future[SearchResponse]],
) -> tuple[list[SearchResponse], list[Shard], Unavailable | None]:
    """The answers, the shards without one, and why one of them is behind, if one is.

    What a shard refuses for good is raised: it is about the query, not about the shard.
    """
    answers: list[SearchResponse] = []
    away: list[Shard] = []
    behind: Unavailable | None = None
    for shard, call in calls.items():
        try:
            answers.append(call.result(timeout=0))
        except (WorkerUnavailable, TimeoutError):
            call.cancel()
            away.append(shard)
        except Unavailable as error:
            if error.code != BEHIND:
                raise
            behind = error
            away.append(shard)
    return answers, away, behind
