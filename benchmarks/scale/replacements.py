"""Alternative ways to store and scan 98,304-dimensional descriptors, with their known speed.

Only the first one is implemented. The others were measured in isolation on synthetic rows that
resemble VLAD's (10,000 to 1,000,000 of them), with two threads on two cores of an EPYC with AVX-512
and VNNI; those on a GPU are estimates.
"""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks.scale.inputs import Inputs

DIMENSION = 98_304
GPU_BYTES_PER_SECOND = 0.8 * 4.8e12  # 80 % of an H200's memory bandwidth
ON_PAPER = "on paper"
ALONE = "measured alone, not built"


@dataclass(frozen=True, slots=True)
class Scan:
    """A scan: `memory_bytes` per row, `row_seconds` of the first pass over all rows."""

    name: str
    memory_bytes: float
    row_seconds: float
    status: str
    note: str


def scans(inputs: Inputs) -> list[Scan]:
    return [
        Scan(
            "float32 rows in memory, exact",
            4 * DIMENSION + inputs.photo_columns_bytes,
            inputs.scan_us_98304 / 1e6,
            "today",
            "every answer is exact",
        ),
        Scan(
            "float16 rows in memory",
            2 * DIMENSION,
            16.6e-6,
            ALONE,
            "same first ten; needs another library than NumPy, which takes 300 us a row",
        ),
        Scan(
            "8-bit rows, rotated, and exact rows on disk",
            DIMENSION,
            3.5e-6,
            ALONE,
            "provably exact by a stored bound; 11 to 15 rows are read",
        ),
        Scan(
            "sign codes, and exact rows on disk",
            DIMENSION / 8,
            0.34e-6,
            ALONE,
            "exact but for odds of about 1 in 10^8 a query; 11 to 15 rows are read where the place "
            "is in the map, hundreds where it is not",
        ),
        Scan(
            "sign codes in steps, 4,096 signs first",
            DIMENSION / 8,
            16e-9,
            ALONE,
            "as before; the time is the first step's, over 512 bytes a row",
        ),
        Scan(
            "float16 rows on GPUs",
            2 * DIMENSION,
            2 * DIMENSION / GPU_BYTES_PER_SECOND,
            ON_PAPER,
            "some 570,000 rows fit into 141 GB with a fifth left free",
        ),
    ]
