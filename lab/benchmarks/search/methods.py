"""Compared search methods, which answer exactly: Placewise, NumPy, faiss, and loading chunks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from uuid import UUID

import faiss
import numpy as np
from numpy.typing import NDArray

from lab.benchmarks.search.brute_force import Ranking
from lab.benchmarks.search.synthetic_map import SyntheticMap
from services.search.executor import SearchOptions, execute_query
from services.search.worker import SearchWorker
from shared.storage.chunks import Row, Rows

PLACEWISE = "Placewise, execute_query()"
NUMPY = "NumPy, resident float32"
FAISS_FLAT = "faiss.IndexFlatIP"
FAISS_PANORAMA = "faiss.IndexFlatIPPanorama"
ALL_CHUNKS = "np.load of every chunk"

PANORAMA_LEVELS = 8  # as in faiss' own benchmark of it

SearchMethod = Callable[[Row, int, float | None], Ranking]
"""Searches with a (dimension,) row, the number of results and the minimum score."""


def load_worker(world: SyntheticMap) -> SearchWorker:
    """Return a search worker that has loaded the map."""
    worker = SearchWorker(world.catalog, world.store, world.settings)
    worker.sync()
    status = worker.status()
    assert not status.missing, status.missing
    assert status.rows == len(world.photo_ids), "every photo can be found"
    return worker


def placewise_search(world: SyntheticMap, worker: SearchWorker) -> SearchMethod:
    """Return Placewise's search on the loaded snapshot, called directly."""
    snapshot = worker.snapshot(world.generation_id, world.version)

    def search(query: Row, k: int, min_score: float | None) -> Ranking:
        options, findable = SearchOptions(k, min_score), snapshot.photos.findable
        found = execute_query(snapshot, query, findable, options, worker.query_batcher)
        return [(hit.photo_id, hit.score) for hit in found.hits]

    return search


def rival_methods(world: SyntheticMap, folder: Path) -> dict[str, SearchMethod]:
    """Return the other methods by name, over float32 copies of the map's rows.

    NumPy and `IndexFlatIP` share one array. Chunks are loaded for each query, as AnyLoc's
    similarity service does, from copies in `folder`.
    """
    ids = world.photo_ids
    flat = faiss.IndexFlatIP(world.dimension)
    paths = []
    for number, path in enumerate(world.chunk_paths()):
        stored = np.load(path).astype(np.float32)
        flat.add(stored)
        paths.append(folder / f"{number}.npy")
        np.save(paths[-1], stored)
    rows: Rows = faiss.rev_swig_ptr(flat.get_xb(), len(ids) * world.dimension)
    rows = rows.reshape(len(ids), world.dimension)
    panorama = faiss.IndexFlatIPPanorama(world.dimension, PANORAMA_LEVELS)
    panorama.add(rows)

    def numpy_search(query: Row, k: int, min_score: float | None) -> Ranking:
        return _top_k(rows @ query, ids, k, min_score)

    def load_all_chunks(query: Row, k: int, min_score: float | None) -> Ranking:
        scores = np.concatenate([np.dot(np.load(path), query) for path in paths])
        return _top_k(scores, ids, k, min_score)

    return {
        NUMPY: numpy_search,
        FAISS_FLAT: _faiss_search(flat, ids),
        FAISS_PANORAMA: _faiss_search(panorama, ids),
        ALL_CHUNKS: load_all_chunks,
    }


def _faiss_search(index: faiss.Index, ids: Sequence[UUID]) -> SearchMethod:
    def search(query: Row, k: int, min_score: float | None) -> Ranking:
        scores, rows = index.search(query[np.newaxis], min(k, len(ids)))
        found = zip(rows[0].tolist(), scores[0].tolist(), strict=True)
        least = -np.inf if min_score is None else min_score
        return [(ids[row], score) for row, score in found if score >= least]

    return search


def _top_k(
    scores: NDArray[np.float32], ids: Sequence[UUID], k: int, min_score: float | None
) -> Ranking:
    """Return the top k of the scores of all rows, which are in the order of the photos."""
    k = min(k, len(scores))
    best = np.argpartition(scores, len(scores) - k)[len(scores) - k :]
    if min_score is not None:
        best = best[scores[best] >= min_score]
    best = best[np.argsort(-scores[best], kind="stable")]
    return [(ids[row], float(scores[row])) for row in best.tolist()]
