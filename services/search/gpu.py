"""Scores of all rows at once by matrix products on a GPU, each within a bound of the exact one.

A generation's rows lie in the device's memory, as float16 where they fit and as int8 codes
(`shared.codes.int8_codes`) where only those do. One product gives every row's score to within a
bound;
rows that may be among the best are compared exactly on the CPU, from their float32 rows. So the
answers are those of the CPU.

The bound of a float16 row: a row x is kept as its nearest float16 numbers h, of 256 x so that none
is too small for float16; a query u, of length 1, as two float16 vectors whose sum v is u to 22
bits. Then

    |<u, x> - <v, h>| <= |u - v| |h| + |x - h|,

with lengths that are measured, not estimated. What is computed of <v, h> is off by the sums: each
is cut in pieces of at most PIECE products, added up in float32 on the device, and the pieces'
sums in float64. Whatever the order, adding n terms in float32 is off by at most n u' times the sum
of their sizes, which is at most |v| |h|; u' is 2^-24 where each sum is rounded. Tensor cores cut
off instead of rounding, and line up the terms of one step before they add them: ADDED, 2^-22, is
twice what that loses at most. A device on which a trial product is off by more is not used
(`Device.trial`). TF32 and sums in float16 never come in: the inputs are float16 or int8, the
outputs float32 or int32.

The products of int8 codes are whole numbers, and exact.
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
from shared.codes.int8_codes import INT8_MAX, Int8Query
from shared.codes.rotation import get_rotation

FLOAT16, INT8 = "float16", "int8"
ROW_FORMATS = (FLOAT16, INT8)  # the one that leaves fewer rows to compare first

PARTIAL_SUM_TERMS = 2048  # products of a row that are added up in float32
ACCUMULATION_ERROR = 2.0**-22  # lost by each at most, as a share of the sum of all sizes
FLOAT16_SCALE = 256.0  # float16 numbers stand for so many times less
RESIDUAL_SCALE = 2.0**11  # the second part of a query stands for so many times less than the first
MAX_INT8_TERMS = 2**31 // (INT8_MAX * INT8_MAX) - 1  # whose int32 sum can't be too large
ROUNDING = 1e-9  # of scores and bounds in float64
ROWS_ALIGNED, COLUMNS_ALIGNED, TERMS_ALIGNED = 32, 8, 8  # what the libraries' fast ways ask for
COPY_ROWS = 64  # that are copied to the device at once
HEADROOM_BYTES = 1 << 30  # of the device's memory are left for products


class GpuError(Exception):
    """The device did not do what it was asked: out of memory, for example."""


class GpuUnsupported(Exception):
    """The device computes less exactly than the bounds allow for."""


@dataclass(frozen=True, slots=True, eq=False)
class GpuQuery:
    """One query of a batch."""

    query: NDArray[np.float32]
    """(dimension,) of any length but 0."""
    row_mask: NDArray[np.bool_]
    """(n,): which rows may be answered."""
    k: int
    min_score: float
    """Rows below this score are not wanted."""


@dataclass(frozen=True, slots=True, eq=False)
class GpuChunk:
    """A chunk's rows on the device."""

    numbers: torch.Tensor
    """float16 (rows, terms) or int8; filled up with zeros to what the libraries ask for."""
    scales: torch.Tensor
    """(n,) float64: what a row's numbers are multiplied by."""
    errors: torch.Tensor
    """(n,) float64: how far they are then from the row, at most."""
    lengths: torch.Tensor
    """(n,) float64: their length then, at most."""

    @property
    def nbytes(self) -> int:
        return self.numbers.nbytes + 3 * self.scales.nbytes


class GpuDevice:
    """One device and its memory."""

    def __init__(
        self, where: torch.device, free_bytes: Callable[[], float], headroom_bytes: int
    ) -> None:
        """`free_bytes` tells how much of its memory can be had now."""
        self.torch_device = where
        self._free_bytes = free_bytes
        self._headroom_bytes = headroom_bytes

    @classmethod
    def cuda(cls) -> GpuDevice | None:
        """The first CUDA device; None where there is none. Unfit when its trial fails."""
        if not torch.cuda.is_available():
            return None
        where = torch.device("cuda", 0)

        def free_bytes() -> int:
            unused = torch.cuda.memory_reserved(where) - torch.cuda.memory_allocated(where)
            return torch.cuda.mem_get_info(where)[0] + unused

        device = cls(where, free_bytes, HEADROOM_BYTES)
        device.self_test()
        return device

    @property
    def name(self) -> str:
        if self.torch_device.type == "cuda":
            return f"{self.torch_device} {torch.cuda.get_device_name(self.torch_device)}"
        return str(self.torch_device)

    def self_test(self) -> None:
        """Multiply rows whose sums are hard to add up; Unfit when that is off by more than the
        bound."""
        draw = np.random.default_rng(0)
        rows = (
            np.abs(draw.standard_normal((64, 3 * PARTIAL_SUM_TERMS)))
            ** np.arange(1, 65)[:, np.newaxis]
        )
        rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
        chunk = self._copy_as_float16(rows)
        try:
            pairs = [
                _score_all_rows([chunk], FLOAT16, row[np.newaxis], self.torch_device)
                for row in rows[::9]
            ]
        except (RuntimeError, TypeError) as error:  # TypeError: before PyTorch 2.8
            raise GpuUnsupported(f"{self.name} can't multiply float16 matrices: {error}") from error
        for row, (scores, bounds) in zip(rows[::9], pairs, strict=True):
            unit = row.astype(np.float64) / np.linalg.norm(row.astype(np.float64))
            exact = rows.astype(np.float64) @ unit
            if not np.all(np.abs(scores[0].cpu().numpy() - exact) <= bounds[0].cpu().numpy()):
                raise GpuUnsupported(f"{self.name} adds up products less exactly than float32 does")

    def load(
        self, chunks: Sequence[LoadedChunk], old: GpuSnapshot | None, most_bytes: float
    ) -> GpuSnapshot | None:
        """A snapshot's rows on the device, of which those in `old` stay; None when they don't fit,
        or more than `most_bytes` would have to be copied. DeviceFailed."""
        kind = next((kind for kind in ROW_FORMATS if self.has_room(chunks, kind, old)), None)
        if kind is None or (kind == INT8 and any(chunk.int8 is None for chunk in chunks)):
            return None
        if _copied_bytes(chunks, kind, old) > most_bytes:
            return None
        known = _reusable_chunks(kind, old)
        try:
            there = {
                chunk.chunk_id: known.get(chunk.chunk_id) or self._copy_chunk(chunk, kind)
                for chunk in chunks
            }
        except RuntimeError as error:  # out of memory is one
            raise GpuError(str(error)) from error
        return GpuSnapshot(self.torch_device, kind, there)

    def has_room(
        self, chunks: Sequence[LoadedChunk], kind: str, old: GpuSnapshot | None = None
    ) -> bool:
        """Whether the chunks' rows fit, of this kind, beside what is there."""
        dimension = chunks[0].rows.shape[1]
        if kind == INT8 and get_rotation(dimension).padded > MAX_INT8_TERMS:
            return False
        needed = _copied_bytes(chunks, kind, old) + self._headroom_bytes
        return needed <= self._free_bytes()

    def _copy_chunk(self, chunk: LoadedChunk, kind: str) -> GpuChunk:
        if kind == FLOAT16:
            return self._copy_as_float16(chunk.rows)
        codes = chunk.int8
        assert codes is not None
        numbers = torch.zeros(
            (_round_up(len(codes), ROWS_ALIGNED), codes.numbers.shape[1]),
            dtype=torch.int8,
            device=self.torch_device,
        )
        for begin in range(0, len(codes), COPY_ROWS):
            slab = np.array(codes.numbers[begin : begin + COPY_ROWS])
            numbers[begin : begin + len(slab)] = torch.from_numpy(slab).to(self.torch_device)
        figures = (codes.scales, codes.errors, codes.lengths)
        return GpuChunk(
            numbers,
            *(torch.from_numpy(one.astype(np.float64)).to(self.torch_device) for one in figures),
        )

    def _copy_as_float16(self, rows: NDArray[np.float32]) -> GpuChunk:
        pieces, piece = _partial_sum_layout(rows.shape[1])
        numbers = torch.zeros(
            (_round_up(len(rows), ROWS_ALIGNED), pieces * piece),
            dtype=torch.float16,
            device=self.torch_device,
        )
        errors = torch.empty(len(rows), dtype=torch.float64, device=self.torch_device)
        lengths = torch.empty_like(errors)
        for begin in range(0, len(rows), COPY_ROWS):
            slab = torch.from_numpy(np.array(rows[begin : begin + COPY_ROWS])).to(self.torch_device)
            half = (slab * FLOAT16_SCALE).half()
            end = begin + len(slab)
            numbers[begin:end, : slab.shape[1]] = half
            back = half.double() / FLOAT16_SCALE
            errors[begin:end] = (slab.double() - back).norm(dim=1)
            lengths[begin:end] = back.norm(dim=1)
        return GpuChunk(numbers, torch.full_like(errors, 1 / FLOAT16_SCALE), errors, lengths)


class GpuSnapshot:
    """A snapshot's rows on a device; immutable. Its memory is free once nothing refers to it."""

    def __init__(self, where: torch.device, kind: str, chunks: Mapping[UUID, GpuChunk]) -> None:
        self.row_format = kind
        self.chunks = chunks
        """In the snapshot's order."""
        self.failure: str | None = None
        """Why it is not to be asked again."""
        self._torch_device = where

    @property
    def nbytes(self) -> int:
        return sum(chunk.nbytes for chunk in self.chunks.values())

    def candidates(self, batch: Sequence[GpuQuery]) -> list[Candidates]:
        """For each query of the batch the rows that may be among its best. DeviceFailed."""
        try:
            queries = np.stack([asked.query for asked in batch])
            scores, bounds = _score_all_rows(
                list(self.chunks.values()), self.row_format, queries, self._torch_device
            )
            return [
                _select_candidates(asked, scores[number], bounds[number])
                for number, asked in enumerate(batch)
            ]
        except RuntimeError as error:
            self.failure = str(error)
            raise GpuError(self.failure) from error


def _select_candidates(asked: GpuQuery, scores: torch.Tensor, bounds: torch.Tensor) -> Candidates:
    wanted = torch.from_numpy(np.array(asked.row_mask)).to(scores.device)
    floor = asked.min_score
    if asked.k <= len(scores):
        certain = torch.where(wanted, scores - bounds, -math.inf)
        floor = max(floor, float(torch.topk(certain, asked.k).values[-1]))
    reach = scores + bounds
    rows = torch.nonzero(wanted & (reach >= floor))[:, 0]
    return Candidates(rows.cpu().numpy(), reach[rows].cpu().numpy(), floor)


def _score_all_rows(
    chunks: Sequence[GpuChunk], kind: str, queries: NDArray[np.float32], where: torch.device
) -> tuple[torch.Tensor, torch.Tensor]:
    """The scores of all rows, (b, n) float64, and how far they are off at most."""
    count = len(queries)
    if kind == FLOAT16:
        columns, errors, added = _float16_query_columns(queries)
        scales = np.full(count, 1 / FLOAT16_SCALE)
        weights = (1.0, 1 / RESIDUAL_SCALE)
    else:
        made = [Int8Query.from_row(query) for query in queries]
        columns = np.concatenate([np.stack([one.parts[part] for one in made]) for part in (0, 1)])
        errors, added = np.array([one.error for one in made]), 0.0
        scales = np.array([one.scale for one in made])
        weights = (128.0, 1.0)
    filled = np.zeros((_round_up(2 * count, COLUMNS_ALIGNED), columns.shape[1]), columns.dtype)
    filled[: 2 * count] = columns
    on_device = torch.from_numpy(filled).to(where)
    parts = []
    for chunk in chunks:
        rows = len(chunk.scales)
        products = (_float16_products if kind == FLOAT16 else _int8_products)(chunk, on_device)[
            :rows
        ]
        sums = weights[0] * products[:, :count] + weights[1] * products[:, count : 2 * count]
        parts.append(sums * chunk.scales[:, None])
    scores = torch.cat(parts) * torch.from_numpy(scales).to(where)
    off = torch.cat([chunk.errors for chunk in chunks])[:, None]
    lengths = torch.cat([chunk.lengths for chunk in chunks])[:, None]
    bounds = off + lengths * (torch.from_numpy(errors).to(where) + added) + ROUNDING
    return scores.T, bounds.T


def _float16_query_columns(
    queries: NDArray[np.float32],
) -> tuple[NDArray[np.float16], NDArray[np.float64], float]:
    """(2 b, terms): the first parts of b queries, then the second; how far their sums are from the
    queries of length 1; and what their products lose in being added up."""
    unit = queries.astype(np.float64)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    first = (unit * FLOAT16_SCALE).astype(np.float16)
    second = ((unit * FLOAT16_SCALE - first) * RESIDUAL_SCALE).astype(np.float16)
    stands_for = (
        first.astype(np.float64) + second.astype(np.float64) / RESIDUAL_SCALE
    ) / FLOAT16_SCALE
    pieces, piece = _partial_sum_layout(queries.shape[1])
    columns = np.zeros((2 * len(queries), pieces * piece), np.float16)
    columns[:, : queries.shape[1]] = np.concatenate([first, second])
    # The lengths of both parts together are less than 1.001.
    return columns, np.linalg.norm(unit - stands_for, axis=1), 1.001 * piece * ACCUMULATION_ERROR


def _float16_products(chunk: GpuChunk, columns: torch.Tensor) -> torch.Tensor:
    """(rows, columns) float64, of sums of pieces in float32."""
    pieces = -(-columns.shape[1] // PARTIAL_SUM_TERMS)
    rows = chunk.numbers.view(len(chunk.numbers), pieces, -1).transpose(0, 1)
    asked = columns.view(len(columns), pieces, -1).permute(1, 2, 0)
    if rows.is_cuda:
        products = torch.bmm(rows, asked, out_dtype=torch.float32)
    else:  # no other device multiplies float16 into float32
        products = torch.bmm(rows.float(), asked.float())
    return products.double().sum(0)


def _int8_products(chunk: GpuChunk, columns: torch.Tensor) -> torch.Tensor:
    """(rows, columns) float64, exact."""
    return torch._int_mm(chunk.numbers, columns.t()).double()


def _partial_sum_layout(dimension: int) -> tuple[int, int]:
    """In how many pieces a row is multiplied, and their length."""
    pieces = -(-dimension // PARTIAL_SUM_TERMS)
    return pieces, _round_up(-(-dimension // pieces), TERMS_ALIGNED)


def _gpu_bytes(chunk: LoadedChunk, kind: str) -> int:
    count, dimension = chunk.rows.shape
    pieces, piece = _partial_sum_layout(dimension)
    terms = 2 * pieces * piece if kind == FLOAT16 else get_rotation(dimension).padded
    return _round_up(count, ROWS_ALIGNED) * (terms + 24)


def _copied_bytes(chunks: Sequence[LoadedChunk], kind: str, old: GpuSnapshot | None) -> int:
    known = _reusable_chunks(kind, old)
    return sum(_gpu_bytes(c, kind) for c in chunks if c.chunk_id not in known)


def _reusable_chunks(kind: str, old: GpuSnapshot | None) -> Mapping[UUID, GpuChunk]:
    return old.chunks if old is not None and old.row_format == kind else {}


def _round_up(number: int, multiple: int) -> int:
    return -(-number // multiple) * multiple
