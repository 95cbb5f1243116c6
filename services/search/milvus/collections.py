"""Collections of Milvus: one for each generation, with a row for each described photo.

A collection also says what it holds, in rows that no search returns: *marks* for the version of the
map up to which changes of photos are in it, and for each chunk that was written completely. They
are lost, or restored from a backup, together with the rows. A collection that is made again has a
new name, so that a snapshot never reads another one than it was made of.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Collection as IdCollection
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from shared.config.settings import Settings
from shared.errors import Misconfigured, Unavailable
from shared.ids import new_id

if TYPE_CHECKING:
    from pymilvus import MilvusClient

log = logging.getLogger(__name__)

Row = Mapping[str, Any]
Vector = NDArray[np.float32]

READ_SECONDS = 4.0  # less than the time that the gateway gives a search
WRITE_SECONDS = 60.0
BATCH_BYTES = 16_000_000  # of rows in one call; a message may have 64 MB
IDS_PER_CALL = 1000
MAX_LIMIT = 16_384  # results of one search
MAX_TEXT_BYTES = 65_535
NO_COLLECTION = 100  # code of an error

MARK = "~"  # begins the key of a mark; those of photos are hexadecimal digits
VERSION_MARK = "~version"
NOTHING = "~nothing"

# Results are exact in float32 with FLAT only. Each is asked for more than it has to return: an
# index that looks at few candidates misses some.
INDEX_PARAMETERS: Mapping[str, Mapping[str, int]] = {
    "FLAT": {},
    "HNSW": {"M": 32, "efConstruction": 200},
    "IVF_FLAT": {"nlist": 1024},
}


def search_parameters(index: str, limit: int) -> dict[str, int]:
    """Return what an approximate index needs to know of each search."""
    return {"HNSW": {"ef": max(256, 2 * limit)}, "IVF_FLAT": {"nprobe": 64}}.get(index, {})


@dataclass(frozen=True, slots=True)
class Marks:
    """What a collection holds: changes up to `version` of the map, and the rows of `chunks`."""

    version: int
    chunks: frozenset[UUID]


@dataclass(frozen=True, slots=True)
class EngineHit:
    """A photo that Milvus found: its product with the query, and its coordinates in degrees."""

    photo_id: UUID
    product: float
    latitude: float
    longitude: float


class CollectionGone(Unavailable):
    """Milvus does not know the collection."""


class Milvus:
    """The collections of one installation; thread-safe.

    Raises:
        Unavailable: `engine_unavailable` if Milvus does not answer, or refuses a call.
    """

    def __init__(self, settings: Settings) -> None:
        """Connect at the first call. Misconfigured (`no_milvus`) without the client."""
        try:
            import pymilvus
        except ImportError as error:
            raise Misconfigured(
                "no_milvus", "SEARCH_ENGINE=milvus needs the extra milvus: pip install pymilvus."
            ) from error
        if not settings.milvus_address:
            raise Misconfigured(
                "no_milvus", "SEARCH_ENGINE=milvus needs MILVUS_URI, such as http://milvus:19530."
            )
        logging.getLogger("pymilvus").setLevel(logging.CRITICAL)  # its errors are raised, too
        self._client_class = pymilvus.MilvusClient
        self._uri = settings.milvus_address
        self.index = settings.milvus_index
        self._lock = threading.Lock()

    @cached_property
    def _client(self) -> MilvusClient:
        parts = urlsplit(self._uri)
        token = "" if parts.username is None else f"{parts.username}:{parts.password or ''}"
        uri = self._uri.replace(f"{token}@", "") if token else self._uri
        return self._client_class(uri, token=token.removeprefix(":"), timeout=READ_SECONDS)

    def call(self, method: str, *args: Any, timeout: float = READ_SECONDS, **options: Any) -> Any:
        """Call a method of the client."""
        try:
            with self._lock:
                client = self._client
            return getattr(client, method)(*args, timeout=timeout, **options)
        except Exception as error:  # of gRPC, too, and whatever a connection that broke leads to
            reason = str(getattr(error, "message", "") or error) or type(error).__name__
            unavailable = Unavailable(
                "engine_unavailable",
                f"Milvus does not answer a call ({method}): {reason}. Retry in a moment.",
            )
            if getattr(error, "code", None) == NO_COLLECTION:
                unavailable = CollectionGone(unavailable.code, unavailable.detail)
            raise unavailable from error

    def names(self, prefix: str) -> list[str]:
        """Return the names of the collections with this prefix, in order."""
        return sorted(n for n in self.call("list_collections") if n.startswith(prefix))

    def open(self, prefix: str) -> MilvusCollection | None:
        """Return the newest collection with this prefix; None if there is none."""
        names = self.names(prefix)
        return MilvusCollection(self, names[-1]) if names else None

    def create(self, prefix: str, dimension: int, version: int) -> MilvusCollection:
        """Create a collection without rows, whose photos are to be written as of `version`."""
        from pymilvus import DataType

        text = {"datatype": DataType.VARCHAR, "max_length": MAX_TEXT_BYTES}
        name = f"{prefix}{new_id().hex}"  # in the order of the time
        schema = self._client_class.create_schema(auto_id=False, enable_dynamic_field=False)
        schema.add_field("photo", DataType.VARCHAR, is_primary=True, max_length=40)
        schema.add_field("vector", DataType.FLOAT_VECTOR, dim=dimension)
        schema.add_field("findable", DataType.BOOL)
        schema.add_field("latitude", DataType.DOUBLE)
        schema.add_field("longitude", DataType.DOUBLE)
        schema.add_field("captured_at", DataType.INT64)
        schema.add_field("place", **text)
        schema.add_field(
            "tags",
            DataType.ARRAY,
            element_type=DataType.VARCHAR,
            max_capacity=4096,
            max_length=MAX_TEXT_BYTES,
        )
        index = self._client_class.prepare_index_params()
        index.add_index(
            "vector",
            index_type=self.index,
            metric_type="IP",
            params=dict(INDEX_PARAMETERS[self.index]),
        )
        options = {"schema": schema, "index_params": index, "consistency_level": "Strong"}
        self.call("create_collection", name, timeout=WRITE_SECONDS, **options)
        collection = MilvusCollection(self, name, dimension)
        collection.mark_version(version)
        return collection

    def drop(self, name: str) -> None:
        self.call("drop_collection", name, timeout=WRITE_SECONDS)


@dataclass(frozen=True, eq=False)
class MilvusCollection:
    """One collection; every call raises as `Milvus` does."""

    milvus: Milvus
    name: str
    known_dimension: int = 0

    @cached_property
    def dimension(self) -> int:
        """Dimension of the rows."""
        if self.known_dimension:
            return self.known_dimension
        fields = self.milvus.call("describe_collection", self.name)["fields"]
        return next(int(f["params"]["dim"]) for f in fields if f["name"] == "vector")

    def marks(self) -> Marks | None:
        """Return what the collection holds; None if it does not say so."""
        self.milvus.call("load_collection", self.name, timeout=WRITE_SECONDS)
        found = self._query(f'photo >= "{MARK}"', ["photo", "captured_at"])
        marks = {row["photo"]: row["captured_at"] for row in found}
        if VERSION_MARK not in marks:
            return None
        return Marks(
            marks.pop(VERSION_MARK), frozenset(UUID(key.removeprefix(MARK)) for key in marks)
        )

    def marked_version(self) -> int | None:
        """Return the version of `marks`."""
        found = self._query(f'photo == "{VERSION_MARK}"', ["captured_at"])
        return found[0]["captured_at"] if found else None

    def mark_version(self, version: int) -> None:
        """Say that all changes up to this version are written."""
        self._mark(VERSION_MARK, version)

    def mark_chunk(self, chunk_id: UUID) -> None:
        """Say that all photos of a chunk are written."""
        self._mark(MARK + chunk_id.hex, 0)

    def unmark_chunks(self, chunk_ids: Iterable[UUID]) -> None:
        """Say that some photos of these chunks are not written."""
        self._delete([MARK + chunk_id.hex for chunk_id in chunk_ids])

    def settle(self) -> None:
        """Let the searches of this process see all that any process has written before.

        They wait for the time of this process's last write ("Session"): with "Strong" each would
        wait for the present time, which Milvus announces five times a second.
        """
        self._delete([NOTHING])

    def _mark(self, key: str, number: int) -> None:
        vector = np.zeros(self.dimension, np.float32)
        vector[0] = 1
        mark = {"photo": key, "vector": vector, "captured_at": number, "findable": False}
        self.put([{**mark, "latitude": 0.0, "longitude": 0.0, "place": "", "tags": []}])

    def put(self, rows: Sequence[Row]) -> None:
        """Write rows, in place of those of the same photos."""
        self.milvus.call("upsert", self.name, list(rows), timeout=WRITE_SECONDS)

    def delete(self, photo_ids: Iterable[UUID]) -> None:
        """Delete the rows of photos, if there are any."""
        self._delete([photo_id.hex for photo_id in photo_ids])

    def _delete(self, keys: Sequence[str]) -> None:
        for some in _chunks(keys, IDS_PER_CALL):
            self.milvus.call("delete", self.name, ids=some, timeout=WRITE_SECONDS)

    def held(self, photo_ids: Sequence[UUID]) -> set[UUID]:
        """Return which of these photos have a row."""
        found: set[UUID] = set()
        for some in _chunks(photo_ids, IDS_PER_CALL):
            found |= {UUID(row["photo"]) for row in self._query(_among(some), ["photo"])}
        return found

    def vectors(self, photo_ids: Sequence[UUID]) -> Iterator[tuple[UUID, Vector]]:
        """Yield the rows of those of these photos that have one."""
        for some in _chunks(photo_ids, max(1, BATCH_BYTES // (4 * self.dimension))):
            for row in self._query(_among(some), ["photo", "vector"]):
                yield UUID(row["photo"]), np.asarray(row["vector"], np.float32)

    def all_photos(self) -> set[UUID]:
        """Return every photo that has a row."""
        iterator = self.milvus.call(
            "query_iterator",
            self.name,
            batch_size=MAX_LIMIT,
            filter=f'photo < "{MARK}"',
            output_fields=["photo"],
            consistency_level="Strong",
            timeout=WRITE_SECONDS,
        )
        found: set[UUID] = set()
        while batch := iterator.next():
            found |= {UUID(row["photo"]) for row in batch}
        return found

    def count(self, condition: str) -> int:
        """Count the rows that meet a condition."""
        return int(self._query(condition, ["count(*)"])[0]["count(*)"])

    def search(self, query: Vector, limit: int, condition: str) -> list[EngineHit]:
        """Return the photos with the largest products with the query, largest first."""
        (found,) = self.milvus.call(
            "search",
            self.name,
            data=[query],
            limit=limit,
            filter=condition,
            output_fields=["photo", "latitude", "longitude"],
            search_params={
                "metric_type": "IP",
                "params": search_parameters(self.milvus.index, limit),
            },
            consistency_level="Session",
        )
        hits = ((hit["entity"], float(hit["distance"])) for hit in found)
        return [
            EngineHit(UUID(row["photo"]), product, row["latitude"], row["longitude"])
            for row, product in hits
        ]

    def _query(self, condition: str, columns: list[str]) -> list[dict[str, Any]]:
        options: dict[str, Any] = {"output_fields": columns, "consistency_level": "Strong"}
        return list(self.milvus.call("query", self.name, filter=condition, **options))


def _among(photo_ids: IdCollection[UUID]) -> str:
    return "photo in [" + ", ".join(f'"{photo_id.hex}"' for photo_id in photo_ids) + "]"


def _chunks(items: Sequence[Any], size: int) -> Iterator[Sequence[Any]]:
    return (items[begin : begin + size] for begin in range(0, len(items), size))
