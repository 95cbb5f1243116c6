"""Collections of Milvus: their schema, their rows, and the mark of what is written."""

from __future__ import annotations

import contextlib
from collections.abc import Collection as Values
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import grpc
from pymilvus import DataType, MilvusClient, MilvusException

from services.search.milvus.filters import filter_columns
from shared.catalog.photos import PhotoFilterValues
from shared.errors import Unavailable
from shared.storage.chunks import Row

T = TypeVar("T")

MILVUS_ERRORS = (MilvusException, grpc.RpcError, grpc.FutureTimeoutError)
READ_SECONDS = 4.0  # less than the time that the gateway gives a search
WRITE_SECONDS = 60.0
IDS_PER_CALL = 1000
MAX_LIMIT = 16_384  # results of one search
MAX_TEXT_BYTES = 65_535
MARK = "~version"  # keys of photos are hexadecimal digits
PHOTOS = 'photo < "~"'
INDEXES = {"FLAT": {}, "HNSW": {"M": 32, "efConstruction": 200}}  # FLAT compares all rows


@contextlib.contextmanager
def engine_errors() -> Iterator[None]:
    """Raise Unavailable (`engine_unavailable`) for errors of Milvus and its connection."""
    try:
        yield
    except MILVUS_ERRORS as error:
        reason = getattr(error, "message", "") or type(error).__name__
        raise Unavailable(
            "engine_unavailable", f"Milvus does not answer: {reason}. Retry in a moment."
        ) from error


@dataclass(frozen=True, slots=True)
class Collection:
    """A collection with a row for each photo; its name ends with its index, such as `_FLAT`.

    A row that is no photo, its *mark*, has the version of the map up to which changes of photos are
    written. Every method raises one of MILVUS_ERRORS.
    """

    client: MilvusClient
    name: str

    @property
    def is_exact(self) -> bool:
        """Whether a search compares all rows."""
        return self.name.endswith("FLAT")

    def create(self, dimension: int, version: int) -> None:
        """Create it; its photos are to be written as of `version`."""
        kind = self.name.rpartition("_")[2]
        text = {"max_length": MAX_TEXT_BYTES}
        schema = MilvusClient.create_schema(auto_id=False, enable_dynamic_field=False)
        schema.add_field("photo", DataType.VARCHAR, is_primary=True, max_length=40)
        schema.add_field("vector", DataType.FLOAT_VECTOR, dim=dimension)
        schema.add_field("findable", DataType.BOOL)
        schema.add_field("captured_at", DataType.INT64)
        schema.add_field("latitude", DataType.DOUBLE)
        schema.add_field("longitude", DataType.DOUBLE)
        schema.add_field("place", DataType.VARCHAR, **text)
        tags = {"element_type": DataType.VARCHAR, "max_capacity": 4096, **text}
        schema.add_field("tags", DataType.ARRAY, **tags)
        index = MilvusClient.prepare_index_params()
        index.add_index("vector", kind, metric_type="IP", params=INDEXES[kind])
        options = {"consistency_level": "Strong", "timeout": WRITE_SECONDS}
        self.client.create_collection(self.name, schema=schema, index_params=index, **options)
        self.write_mark(dimension, version)

    def load(self) -> int | None:
        """Load its rows into memory and return the version of its mark, None if it has none."""
        self.client.load_collection(self.name, timeout=WRITE_SECONDS)
        return self.read_mark()

    def drop(self) -> None:
        """Remove it with its rows."""
        self.client.drop_collection(self.name, timeout=WRITE_SECONDS)

    def read_mark(self) -> int | None:
        """Return the version up to which changes are written; None without a mark."""
        found = self.get([MARK], "captured_at")
        return found[0] if found else None

    def write_mark(self, dimension: int, version: int) -> None:
        """Say that all changes up to this version are written."""
        mark = {"photo": MARK, "captured_at": version, "findable": False, "place": "", "tags": []}
        where = {"latitude": 0.0, "longitude": 0.0, "vector": [1.0] + [0.0] * (dimension - 1)}
        self.client.upsert(self.name, [mark | where], timeout=WRITE_SECONDS)

    def get(self, keys: Sequence[str], column: str) -> list[Any]:
        """Return the column of those of these rows that are there."""
        options = {"output_fields": [column], "consistency_level": "Strong"}
        get = partial(self.client.get, self.name, timeout=READ_SECONDS, **options)
        return [row[column] for some in batches(keys, IDS_PER_CALL) for row in get(some)]

    def count(self, condition: str) -> int:
        """Return the number of rows."""
        options = {"output_fields": ["count(*)"], "consistency_level": "Strong"}
        found = self.client.query(self.name, filter=condition, timeout=READ_SECONDS, **options)
        return int(found[0]["count(*)"])

    def find_others(self, keys: Values[str]) -> set[str]:
        """Return the photos that are there, but none of these."""
        others = set[str]()
        options = {"output_fields": ["photo"], "consistency_level": "Strong", "filter": PHOTOS}
        rows = self.client.query_iterator(self.name, MAX_LIMIT, timeout=WRITE_SECONDS, **options)
        while batch := rows.next():
            others |= {row["photo"] for row in batch} - set(keys)
        return others

    def write(self, photos: Sequence[tuple[PhotoFilterValues, Row]], per_call: int) -> None:
        """Write photos with their rows, or replace them."""
        for some in batches(photos, min(per_call, IDS_PER_CALL)):
            data = [{**filter_columns(photo), "vector": row} for photo, row in some]
            self.client.upsert(self.name, data, timeout=WRITE_SECONDS)

    def delete(self, keys: Sequence[str]) -> None:
        """Delete rows that may be there."""
        for some in batches(keys, IDS_PER_CALL):
            self.client.delete(self.name, ids=some, timeout=WRITE_SECONDS)

    def search(self, query: Row, limit: int, condition: str) -> list[Any]:
        """Return the rows with the largest products with the query, largest first."""
        # An index that looks at no more candidates than it returns misses some.
        effort = {} if self.is_exact else {"ef": max(256, 2 * limit)}
        (found,) = self.client.search(
            self.name,
            data=[query],
            limit=limit,
            filter=condition,
            output_fields=["photo", "latitude", "longitude"],
            search_params={"metric_type": "IP", "params": effort},
            consistency_level="Session",
            timeout=READ_SECONDS,
        )
        return list(found)


def batches(items: Sequence[T], size: int) -> Iterator[Sequence[T]]:
    """Yield parts of at most `size` items."""
    return (items[begin : begin + size] for begin in range(0, len(items), size))
