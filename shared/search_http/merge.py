"""One answer from the answers of the shards."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping, Sequence
from uuid import UUID

from shared.search_protocol import CERTIFICATES, NONE, SearchHit, SearchResponse, SearchStatus
from shared.shards import Shard


def merge_responses(
    answers: Sequence[SearchResponse], k: int, unreachable: Iterable[Shard] = ()
) -> SearchResponse:
    """The first `k` hits of all, and what has to be known of the way to them: the sums, the least
    version, the weakest certificate. `unreachable` are the shards that are missing, and are named: of an
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
