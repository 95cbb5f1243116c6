"""Asking one generation of a live map with its own photos, through the search tier."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from uuid import UUID

from services.steward.located import GeotaggedPhoto
from shared.catalog.chunks import find_descriptor
from shared.catalog.generations import Generation
from shared.catalog.session import Catalog
from shared.errors import Conflict, Gone, Unavailable
from shared.estimate.places import PhotoLocation
from shared.search_protocol import SearchBackend, SearchHit, SearchRequest
from shared.shards import is_shard_name

MAX_READ_ATTEMPTS = 2

UNKNOWN_LOCATION = PhotoLocation(None, None, None)

LocatedRanking = list[tuple[SearchHit, PhotoLocation]]
RankPhoto = Callable[[GeotaggedPhoto, int], LocatedRanking | None]
"""`Asker.ask`, with the weights chosen."""


class EvaluationSearch:
    """Asks with stored photos; `photos` are those whose spots are known."""

    def __init__(
        self,
        catalog: Catalog,
        search: SearchBackend,
        generation: Generation,
        version: int,
        photos: Mapping[UUID, GeotaggedPhoto],
    ) -> None:
        self._catalog = catalog
        self._search = search
        self._generation = generation
        self._version = version
        self._photos = photos

    def rank_similar(
        self,
        query: GeotaggedPhoto,
        k: int,
        weights: tuple[float, ...] = (),
        excluded_photos: tuple[UUID, ...] = (),
    ) -> LocatedRanking | None:
        """The k most similar database photos and their spots, without the query itself and those
        of `excluded_photos`; None for a query that was deleted since. Conflict (`map_damaged`) when a part
        can't be searched."""
        for attempt in range(1, MAX_READ_ATTEMPTS + 1):
            with self._catalog.read() as session:
                found = find_descriptor(session, self._generation.id, query.photo_id)
            if found is None:
                return None
            descriptor, chunk = found
            request = SearchRequest(
                map_id=self._generation.map_id,
                generation_id=self._generation.id,
                object_key=chunk.object_key,
                row=descriptor.row,
                min_version=self._version,
                k=k,
                exclude=(query.photo_id, *excluded_photos),
                word_weights=weights,
            )
            try:
                answer = self._search.search(request)
            except Gone:  # its chunk was merged into another between the two calls
                if attempt == MAX_READ_ATTEMPTS:
                    raise
                continue
            except Unavailable as error:
                if error.code == "chunk_unreadable":
                    raise map_damaged_error([chunk.object_key]) from error
                raise
            if any(is_shard_name(part) for part in answer.missing):
                raise Unavailable(
                    "search_incomplete",
                    f"Without {', '.join(answer.missing)} the figures would be those of a part "
                    "of the map.",
                )
            if answer.missing:
                raise map_damaged_error(answer.missing)
            return [(hit, self._location(hit)) for hit in answer.hits]
        raise AssertionError("the last try returns or raises")

    def _location(self, hit: SearchHit) -> PhotoLocation:
        found = self._photos.get(hit.photo_id)
        return found.spot if found else UNKNOWN_LOCATION


def map_damaged_error(missing: Sequence[str]) -> Conflict:
    """What figures of the rest would hide."""
    return Conflict(
        "map_damaged",
        f"{', '.join(missing)} can't be read, and figures of a part of the map would mislead. "
        "Restore it from a backup, or describe its photos again, then evaluate.",
    )
