"""Asking one generation of a live map with its own photos, through the search tier."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from uuid import UUID

from services.steward.located import Located
from shared.catalog.chunks import descriptor_of
from shared.catalog.generations import Generation
from shared.catalog.session import Catalog
from shared.errors import Conflict, Gone, Unavailable
from shared.estimate.places import Spot
from shared.search_protocol import Hit, SearchPort, SearchRequest
from shared.shards import names_a_shard

TRIES = 2

UNKNOWN = Spot(None, None, None)

Ranking = list[tuple[Hit, Spot]]
Ask = Callable[[Located, int], Ranking | None]
"""`Asker.ask`, with the weights chosen."""


class Asker:
    """Asks with stored photos; `photos` are those whose spots are known."""

    def __init__(
        self,
        catalog: Catalog,
        search: SearchPort,
        generation: Generation,
        version: int,
        photos: Mapping[UUID, Located],
    ) -> None:
        self._catalog = catalog
        self._search = search
        self._generation = generation
        self._version = version
        self._photos = photos

    def ask(
        self,
        query: Located,
        k: int,
        weights: tuple[float, ...] = (),
        without: tuple[UUID, ...] = (),
    ) -> Ranking | None:
        """The k most similar database photos and their spots, without the query itself and those
        of `without`; None for a query that was deleted since. Conflict (`map_damaged`) when a part
        can't be searched."""
        for attempt in range(1, TRIES + 1):
            with self._catalog.read() as session:
                found = descriptor_of(session, self._generation.id, query.photo_id)
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
                exclude=(query.photo_id, *without),
                word_weights=weights,
            )
            try:
                answer = self._search.search(request)
            except Gone:  # its chunk was merged into another between the two calls
                if attempt == TRIES:
                    raise
                continue
            except Unavailable as error:
                if error.code == "chunk_unreadable":
                    raise damaged([chunk.object_key]) from error
                raise
            if any(names_a_shard(part) for part in answer.missing):
                raise Unavailable(
                    "search_incomplete",
                    f"Without {', '.join(answer.missing)} the figures would be those of a part "
                    "of the map.",
                )
            if answer.missing:
                raise damaged(answer.missing)
            return [(hit, self._spot(hit)) for hit in answer.hits]
        raise AssertionError("the last try returns or raises")

    def _spot(self, hit: Hit) -> Spot:
        found = self._photos.get(hit.photo_id)
        return found.spot if found else UNKNOWN


def damaged(missing: Sequence[str]) -> Conflict:
    """What figures of the rest would hide."""
    return Conflict(
        "map_damaged",
        f"{', '.join(missing)} can't be read, and figures of a part of the map would mislead. "
        "Restore it from a backup, or describe its photos again, then evaluate.",
    )
