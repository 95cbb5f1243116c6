"""Route that exports the descriptors of a generation as a tar archive.

One archive holds the descriptors and the table of their photos, so that both are from the same
snapshot. It is streamed with one chunk in memory at a time.
"""

from __future__ import annotations

import contextlib
import csv
import io
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime
from typing import IO, Any

import numpy as np
from fastapi import APIRouter
from fastapi.responses import StreamingResponse
from sqlalchemy import select
from sqlalchemy.orm import Session

from services.gateway.authentication import READ
from services.gateway.dependencies import GatewayDep, GenerationId, MapQuery
from services.gateway.responses import describe_tar, tar_response
from shared.catalog.chunks import Descriptor, list_live_chunks
from shared.catalog.database.base import get_in_map
from shared.catalog.generations import Generation
from shared.catalog.maps import get_map
from shared.catalog.photos import Photo
from shared.ingest.photo_metadata import escape_csv_text
from shared.storage import ObjectStore
from shared.storage.chunks import read_chunk

router = APIRouter(tags=["models"])

SPOOL_BYTES = 8 * 1024 * 1024  # larger tables are spooled to a temporary file
STREAM_READ_BYTES = 256 * 1024
PHOTO_COLUMNS = (
    Photo.filename,
    Photo.latitude,
    Photo.longitude,
    Photo.altitude,
    Photo.heading,
    Photo.captured_at,
    Photo.place,
    Photo.role,
    Photo.relative_path,
)
CSV_HEADER = ("row", "image_id", *(column.key for column in PHOTO_COLUMNS))


@dataclass(frozen=True, slots=True)
class _ChunkRows:
    """The rows of live photos in one chunk."""

    object_key: str
    sha256: str
    rows: list[int]


@router.get(
    "/generations/{generation_id}/descriptors",
    dependencies=[READ],
    response_class=StreamingResponse,
    responses=describe_tar("A tar with `photos.csv`, `names.txt` and `descriptors.npy`."),
)
def export_descriptors(
    gateway: GatewayDep, generation_id: GenerationId, query: MapQuery
) -> StreamingResponse:
    """Download the descriptors of all live photos as a tar archive.

    `descriptors.npy` has the shape (photos, dimension) and the type float32, with L2-normalised
    rows; `photos.csv` and `names.txt` are in the same order.
    """
    with contextlib.ExitStack() as files, gateway.catalog.read() as session:
        generation = get_in_map(session, Generation, get_map(session, query.map).id, generation_id)
        table = files.enter_context(tempfile.SpooledTemporaryFile(SPOOL_BYTES))
        names = files.enter_context(tempfile.SpooledTemporaryFile(SPOOL_BYTES))
        chunks = _write_tables(session, generation, table, names)
        header = _npy_header(sum(len(chunk.rows) for chunk in chunks), generation.dimension)
        files = files.pop_all()  # closed by `members`
    rows = sum(len(chunk.rows) for chunk in chunks)
    size = len(header) + rows * generation.dimension * np.dtype(np.float32).itemsize

    def members() -> Iterator[tuple[str, int, Iterable[bytes]]]:
        with files:
            yield "photos.csv", table.tell(), _read_blocks(table)
            yield "names.txt", names.tell(), _read_blocks(names)
            yield "descriptors.npy", size, _stream_rows(gateway.store, header, chunks)

    return tar_response(f"descriptors-{generation.id}.tar", generation.created_at, members())


def _write_tables(
    session: Session, generation: Generation, table: IO[bytes], names: IO[bytes]
) -> list[_ChunkRows]:
    """Write photos.csv to `table` and names.txt to `names`; return the rows to export."""
    chunks: list[_ChunkRows] = []
    number = 0
    for chunk in list_live_chunks(session, generation.id):
        photo_rows = session.execute(
            select(Descriptor.row, Photo.id, *PHOTO_COLUMNS)
            .join(Photo, Photo.id == Descriptor.photo_id)
            .where(Descriptor.chunk_id == chunk.id, Photo.deleted_at.is_(None))
            .order_by(Descriptor.row)
        ).all()
        lines = io.StringIO(newline="")
        writer = csv.writer(lines)
        if not chunks:
            writer.writerow(CSV_HEADER)
        for photo in photo_rows:
            writer.writerow([number, *map(_csv_cell, photo[1:])])
            # A file name may contain line breaks.
            names.write(" ".join(photo.filename.splitlines()).encode() + b"\n")
            number += 1
        table.write(lines.getvalue().encode())
        rows = [row[0] for row in photo_rows]
        chunks.append(_ChunkRows(chunk.object_key, chunk.sha256, rows))
    if not chunks:
        table.write(",".join(CSV_HEADER).encode() + b"\r\n")
    return chunks


def _csv_cell(value: Any) -> Any:
    if isinstance(value, datetime):
        return value.isoformat()
    return escape_csv_text(value) if isinstance(value, str) else value


def _npy_header(rows: int, dimension: int) -> bytes:
    buffer = io.BytesIO()
    header = {"descr": "<f4", "fortran_order": False, "shape": (rows, dimension)}
    np.lib.format.write_array_header_1_0(buffer, header)
    return buffer.getvalue()


def _stream_rows(store: ObjectStore, header: bytes, chunks: list[_ChunkRows]) -> Iterator[bytes]:
    yield header
    for chunk in chunks:
        if chunk.rows:
            rows = read_chunk(store, chunk.object_key, chunk.sha256)
            for row in chunk.rows:
                yield rows[row].astype(np.float32).tobytes()


def _read_blocks(file: IO[bytes]) -> Iterator[bytes]:
    file.seek(0)
    while piece := file.read(STREAM_READ_BYTES):
        yield piece
