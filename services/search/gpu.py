"""GPU search: scores of all rows by matrix products, each with a bound of its error.

A generation's rows are held in the GPU's memory as float16 if they fit. One product gives every
row's score to within a bound; rows that may be among the best are compared exactly on the CPU, by
their stored rows. So the results are the same as those of the CPU.

Error bound of a float16 row: a row x is stored as the float16 numbers h nearest to it, scaled by
256 so that none underflows; a query u of length 1 is stored as two float16 vectors whose sum v
equals u to 22 bits. Then

    |<u, x> - <v, h>| <= |u - v| |h| + |x - h|,

with lengths that are measured, not estimated. The computed <v, h> has summation errors: each sum is
split into parts of at most PARTIAL_SUM_TERMS products, which are summed in float32 on the device,
and the parts in float64. In any order, the error of summing n terms in float32 is at most n u'
times the sum of their magnitudes, which is at most |v| |h|; u' is 2^-24 if each sum is rounded.
Tensor cores truncate instead of rounding, and align the terms of one step before they add them:
ACCUMULATION_ERROR, 2^-22, is twice the most that this loses. A device whose trial product is off by
more is not used (`GpuDevice.self_test`). TF32 and sums in float16 are never used: the inputs are
float16, the outputs float32.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from uuid import UUID

import numpy as np
import torch
from numpy.typing import NDArray

from services.search.chunk_loader import LoadedChunk
from services.search.int8_search import Candidates
from shared.storage.chunks import StoredRows

PARTIAL_SUM_TERMS = 2048  # products of a row that are summed in float32
ACCUMULATION_ERROR = 2.0**-22  # error of each addition, relative to the sum of all magnitudes
FLOAT16_SCALE = 256.0  # factor by which stored float16 numbers are larger than the row's
RESIDUAL_SCALE = 2.0**11  # further factor of the second float16 vector of a query
ROUNDING = 1e-9  # bound of rounding errors of scores and bounds in float64
ROWS_ALIGNED, COLUMNS_ALIGNED, TERMS_ALIGNED = 32, 8, 8  # alignment for the fast GPU kernels
COPY_ROWS = 64  # rows copied to the device at once
HEADROOM_BYTES = 1 << 30  # device memory reserved for products


class GpuError(Exception):
    """A GPU operation failed, for example for lack of memory."""


class GpuUnsupported(Exception):
    """The GPU lacks an operation, or computes less precisely than the bounds allow for."""


@dataclass(frozen=True, slots=True, eq=False)
class GpuQuery:
    """One query of a batch."""

    query: NDArray[np.float32]
    """(dimension,) row of any length but 0."""
    row_mask: NDArray[np.bool_]
    """(n,): rows that may be returned."""
    k: int
    min_score: float
    """Minimum score, or -inf."""


@dataclass(frozen=True, slots=True, eq=False)
class _GpuChunk:
    """A chunk's rows in GPU memory."""

    numbers: torch.Tensor
    """(rows, terms) float16, FLOAT16_SCALE times the row, padded with zeros to the alignment."""
    errors: torch.Tensor
    """(n,) float64: upper bound of the distance of the scaled numbers from the row."""
    lengths: torch.Tensor
    """(n,) float64: upper bound of the length of the scaled numbers."""

    @property
    def nbytes(self) -> int:
        return self.numbers.nbytes + self.errors.nbytes + self.lengths.nbytes


class GpuDevice:
    """A GPU, with its memory."""

    def __init__(
        self, torch_device: torch.device, free_bytes: Callable[[], float], headroom_bytes: int
    ) -> None:
        """`free_bytes` returns what is free now; `headroom_bytes` are reserved for products."""
        self.torch_device = torch_device
        self._free_bytes = free_bytes
        self._headroom_bytes = headroom_bytes

    @classmethod
    def cuda(cls) -> GpuDevice | None:
        """Return the first CUDA device, tested; None if there is none.

        Raises:
            GpuUnsupported: The self-test failed.
        """
        if not torch.cuda.is_available():
            return None
        torch_device = torch.device("cuda", 0)

        def free_bytes() -> int:
            unused = torch.cuda.memory_reserved(torch_device) - torch.cuda.memory_allocated(
                torch_device
            )
            return torch.cuda.mem_get_info(torch_device)[0] + unused

        device = cls(torch_device, free_bytes, HEADROOM_BYTES)
        device.self_test()
        return device

    @property
    def name(self) -> str:
        if self.torch_device.type == "cuda":
            return f"{self.torch_device} {torch.cuda.get_device_name(self.torch_device)}"
        return str(self.torch_device)

    def self_test(self) -> None:
        """Multiply rows whose products are hard to sum precisely.

        Raises:
            GpuUnsupported: float16 products are unsupported, or an error exceeds its bound.
        """
        rng = np.random.default_rng(0)
        rows = (
            np.abs(rng.standard_normal((64, 3 * PARTIAL_SUM_TERMS)))
            ** np.arange(1, 65)[:, np.newaxis]
        )
        rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
        chunk = self._copy_as_float16(rows)
        try:
            results = [
                _score_all_rows([chunk], row[np.newaxis], self.torch_device) for row in rows[::9]
            ]
        except (RuntimeError, TypeError) as error:  # TypeError: before PyTorch 2.8
            raise GpuUnsupported(f"{self.name} can't multiply float16 matrices: {error}") from error
        for row, (scores, bounds) in zip(rows[::9], results, strict=True):
            unit = row.astype(np.float64) / np.linalg.norm(row.astype(np.float64))
            exact = rows.astype(np.float64) @ unit
            if not np.all(np.abs(scores[0].cpu().numpy() - exact) <= bounds[0].cpu().numpy()):
                raise GpuUnsupported(f"{self.name} sums products less precisely than float32 does")

    def load(
        self, chunks: Sequence[LoadedChunk], old: GpuSnapshot | None, max_bytes: float
    ) -> GpuSnapshot | None:
        """Load a snapshot's rows into GPU memory, reusing those of the previous one, if any.

        Returns:
            The rows; None if they don't fit, or more than `max_bytes` would have to be copied.

        Raises:
            GpuError: The copy failed.
        """
        reusable = {} if old is None else old.chunks
        copied_bytes = sum(_gpu_bytes(c) for c in chunks if c.chunk_id not in reusable)
        if copied_bytes > min(max_bytes, self._free_bytes() - self._headroom_bytes):
            return None
        try:
            gpu_chunks = {
                chunk.chunk_id: reusable.get(chunk.chunk_id) or self._copy_as_float16(chunk.rows)
                for chunk in chunks
            }
        except RuntimeError as error:  # includes out-of-memory errors
            raise GpuError(str(error)) from error
        return GpuSnapshot(self.torch_device, gpu_chunks)

    def _copy_as_float16(self, rows: StoredRows) -> _GpuChunk:
        parts, part_terms = _partial_sum_layout(rows.shape[1])
        numbers = torch.zeros(
            (_round_up(len(rows), ROWS_ALIGNED), parts * part_terms),
            dtype=torch.float16,
            device=self.torch_device,
        )
        errors = torch.empty(len(rows), dtype=torch.float64, device=self.torch_device)
        lengths = torch.empty_like(errors)
        for begin in range(0, len(rows), COPY_ROWS):
            block = torch.from_numpy(np.array(rows[begin : begin + COPY_ROWS])).to(
                self.torch_device
            )
            scaled = (block * FLOAT16_SCALE).half()
            end = begin + len(block)
            numbers[begin:end, : block.shape[1]] = scaled
            stored = scaled.double() / FLOAT16_SCALE
            errors[begin:end] = (block.double() - stored).norm(dim=1)
            lengths[begin:end] = stored.norm(dim=1)
        return _GpuChunk(numbers, errors, lengths)


class GpuSnapshot:
    """A snapshot's rows in GPU memory; immutable. The memory is freed with its last reference."""

    def __init__(self, torch_device: torch.device, chunks: Mapping[UUID, _GpuChunk]) -> None:
        self.chunks = chunks
        """Chunks by id, in the snapshot's order."""
        self.failure: str | None = None
        """Error after which it must not be used any more; None while it works."""
        self._torch_device = torch_device

    @property
    def nbytes(self) -> int:
        return sum(chunk.nbytes for chunk in self.chunks.values())

    def candidates(self, batch: Sequence[GpuQuery]) -> list[Candidates]:
        """Find the rows that may be among the best, for each query of a batch.

        Raises:
            GpuError: The GPU failed; `failure` is set.
        """
        try:
            queries = np.stack([query.query for query in batch])
            scores, bounds = _score_all_rows(
                list(self.chunks.values()), queries, self._torch_device
            )
            return [
                _select_candidates(query, scores[index], bounds[index])
                for index, query in enumerate(batch)
            ]
        except RuntimeError as error:
            self.failure = str(error)
            raise GpuError(self.failure) from error


def _select_candidates(query: GpuQuery, scores: torch.Tensor, bounds: torch.Tensor) -> Candidates:
    row_mask = torch.from_numpy(np.array(query.row_mask)).to(scores.device)
    floor = query.min_score
    if query.k <= len(scores):
        lower_bounds = torch.where(row_mask, scores - bounds, -math.inf)
        floor = max(floor, float(torch.topk(lower_bounds, query.k).values[-1]))
    upper_bounds = scores + bounds
    rows = torch.nonzero(row_mask & (upper_bounds >= floor))[:, 0]
    return Candidates(rows.cpu().numpy(), upper_bounds[rows].cpu().numpy(), floor)


def _score_all_rows(
    chunks: Sequence[_GpuChunk],
    queries: NDArray[np.float32],
    torch_device: torch.device,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return scores of all rows for b queries, (b, n) float64, and bounds of their errors."""
    count = len(queries)
    columns, errors, accumulation_error = _float16_query_columns(queries)
    padded = np.zeros((_round_up(2 * count, COLUMNS_ALIGNED), columns.shape[1]), columns.dtype)
    padded[: 2 * count] = columns
    on_device = torch.from_numpy(padded).to(torch_device)
    chunk_scores = []
    for chunk in chunks:
        products = _float16_products(chunk, on_device)[: len(chunk.errors)]
        chunk_scores.append(products[:, :count] + products[:, count : 2 * count] / RESIDUAL_SCALE)
    scores = torch.cat(chunk_scores) / FLOAT16_SCALE**2
    row_errors = torch.cat([chunk.errors for chunk in chunks])[:, None]
    lengths = torch.cat([chunk.lengths for chunk in chunks])[:, None]
    bounds = (
        row_errors
        + lengths * (torch.from_numpy(errors).to(torch_device) + accumulation_error)
        + ROUNDING
    )
    return scores.T, bounds.T


def _float16_query_columns(
    queries: NDArray[np.float32],
) -> tuple[NDArray[np.float16], NDArray[np.float64], float]:
    """Split b queries, scaled to length 1, into two float16 vectors each.

    Returns:
        (2 b, terms) the first vectors, then the second ones; (b,) distances of their sums from the
        queries; and the summation error of their products.
    """
    unit = queries.astype(np.float64)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    first = (unit * FLOAT16_SCALE).astype(np.float16)
    second = ((unit * FLOAT16_SCALE - first) * RESIDUAL_SCALE).astype(np.float16)
    restored = (
        first.astype(np.float64) + second.astype(np.float64) / RESIDUAL_SCALE
    ) / FLOAT16_SCALE
    parts, part_terms = _partial_sum_layout(queries.shape[1])
    columns = np.zeros((2 * len(queries), parts * part_terms), np.float16)
    columns[:, : queries.shape[1]] = np.concatenate([first, second])
    # The lengths of both vectors sum to less than 1.001.
    return columns, np.linalg.norm(unit - restored, axis=1), 1.001 * part_terms * ACCUMULATION_ERROR


def _float16_products(chunk: _GpuChunk, columns: torch.Tensor) -> torch.Tensor:
    """Products (rows, columns) in float64, of partial sums in float32."""
    parts = -(-columns.shape[1] // PARTIAL_SUM_TERMS)
    rows = chunk.numbers.view(len(chunk.numbers), parts, -1).transpose(0, 1)
    queries = columns.view(len(columns), parts, -1).permute(1, 2, 0)
    if rows.is_cuda:
        products = torch.bmm(rows, queries, out_dtype=torch.float32)
    else:  # other devices can't multiply float16 with a float32 result
        products = torch.bmm(rows.float(), queries.float())
    return products.double().sum(0)


def _partial_sum_layout(dimension: int) -> tuple[int, int]:
    """Number of partial sums of a row, and the terms of each."""
    parts = -(-dimension // PARTIAL_SUM_TERMS)
    return parts, _round_up(-(-dimension // parts), TERMS_ALIGNED)


def _gpu_bytes(chunk: LoadedChunk) -> int:
    count, dimension = chunk.rows.shape
    parts, part_terms = _partial_sum_layout(dimension)
    return _round_up(count, ROWS_ALIGNED) * (2 * parts * part_terms + 16)


def _round_up(number: int, multiple: int) -> int:
    return -(-number // multiple) * multiple
