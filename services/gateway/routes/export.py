"""`/generations/{generation_id}/descriptors`: the rows of a generation, for other programs.

A tar, because rows and what they belong to must be of one moment. It is streamed: one chunk is in
memory at a time.
"""

from __future__ import annotations

import contextlib
import csv
import io
import tarfile
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO, Any

import numpy as np
from fastapi import APIRouter
from fastapi.responses import StreamingResponse
from sqlalchemy import select
from sqlalchemy.orm import Session

from services.gateway.authentication import READ
from services.gateway.dependencies import DEFAULT_MAP, GatewayDep, GenerationId, MapName
from shared.catalog.chunks import Descriptor, list_live_chunks
from shared.catalog.generations import Generation, get_generation
from shared.catalog.maps import get_map
from shared.catalog.photos import Photo
from shared.storage import ObjectStore
from shared.storage.chunks import read_chunk

router = APIRouter(tags=["models"])

SPOOL_BYTES = 8 * 1024 * 1024  # of a table; more goes to a temporary file
STREAM_READ_BYTES = 256 * 1024
CSV_COLUMNS = (
    "row",
    "image_id",
    "filename",
    "latitude",
    "longitude",
    "heading",
    "captured_at",
    "place",
    "role",
)
TAR_RESPONSE: dict[int | str, dict[str, Any]] = {
    200: {
        "content": {"application/x-tar": {"schema": {"type": "string", "format": "binary"}}},
        "description": "A tar with `photos.csv`, `names.txt` and `descriptors.npy`.",
    }
}


@dataclass(frozen=True, slots=True)
class _ChunkRows:
    """The live rows of one chunk."""

    object_key: str
    sha256: str
    rows: list[int]


@router.get(
    "/generations/{generation_id}/descriptors",
    dependencies=[READ],
    operation_id="export_descriptors",
    response_class=StreamingResponse,
    responses=TAR_RESPONSE,
)
def export_descriptors(
    gateway: GatewayDep,
    generation_id: GenerationId,
    map_name: MapName = DEFAULT_MAP,
) -> StreamingResponse:
    """Every live photo's descriptor: `descriptors.npy`, (photos, dimension) float32, each row of
    length 1; in the same order `photos.csv` and `names.txt`.
    """
    with contextlib.ExitStack() as files, gateway.catalog.read() as session:
        generation = get_generation(session, get_map(session, map_name).id, generation_id)
        table = files.enter_context(tempfile.SpooledTemporaryFile(SPOOL_BYTES))
        names = files.enter_context(tempfile.SpooledTemporaryFile(SPOOL_BYTES))
        parts = _write_tables(session, generation, table, names)
        header = _npy_header(sum(len(part.rows) for part in parts), generation.dimension)
        files = files.pop_all()  # now the stream's, which closes them
    rows = sum(len(part.rows) for part in parts)
    size = len(header) + rows * generation.dimension * np.dtype(np.float32).itemsize
    members = [("photos.csv", table.tell()), ("names.txt", names.tell()), ("descriptors.npy", size)]

    def stream() -> Iterator[bytes]:
        with files:
            for (name, size_bytes), content in zip(
                members,
                (
                    _read_blocks(table),
                    _read_blocks(names),
                    _stream_rows(gateway.store, header, parts),
                ),
                strict=True,
            ):
                about = tarfile.TarInfo(name)
                about.size, about.mtime = size_bytes, int(generation.created_at.timestamp())
                yield about.tobuf(tarfile.GNU_FORMAT)
                yield from content
                yield bytes(-size_bytes % tarfile.BLOCKSIZE)
            yield bytes(2 * tarfile.BLOCKSIZE)

    length = sum(_padded_to_block(size_bytes) + tarfile.BLOCKSIZE for _, size_bytes in members)
    return StreamingResponse(
        stream(),
        media_type="application/x-tar",
        headers={
            # Whoever receives less knows that it is not whole.
            "Content-Length": str(length + 2 * tarfile.BLOCKSIZE),
            "Content-Disposition": f'attachment; filename="descriptors-{generation.id}.tar"',
        },
    )


def _write_tables(
    session: Session, generation: Generation, table: IO[bytes], names: IO[bytes]
) -> list[_ChunkRows]:
    parts: list[_ChunkRows] = []
    number = 0
    for chunk in list_live_chunks(session, generation.id):
        found = session.execute(
            select(
                Descriptor.row,
                Photo.id,
                Photo.filename,
                Photo.latitude,
                Photo.longitude,
                Photo.heading,
                Photo.captured_at,
                Photo.place,
                Photo.role,
            )
            .join(Photo, Photo.id == Descriptor.photo_id)
            .where(Descriptor.chunk_id == chunk.id, Photo.deleted_at.is_(None))
            .order_by(Descriptor.row)
        ).all()
        lines = io.StringIO(newline="")
        writer = csv.writer(lines)
        if not parts:
            writer.writerow(CSV_COLUMNS)
        for _, photo_id, name, latitude, longitude, heading, at, place, role in found:
            taken = at.isoformat() if at else None
            writer.writerow(
                [number, photo_id, name, latitude, longitude, heading, taken, place, str(role)]
            )
            # A name is one line, whatever the file was called.
            names.write(" ".join(name.splitlines()).encode() + b"\n")
            number += 1
        table.write(lines.getvalue().encode())
        parts.append(_ChunkRows(chunk.object_key, chunk.sha256, [row[0] for row in found]))
    if not parts:
        table.write(",".join(CSV_COLUMNS).encode() + b"\r\n")
    return parts


def _npy_header(rows: int, dimension: int) -> bytes:
    buffer = io.BytesIO()
    about = {"descr": "<f4", "fortran_order": False, "shape": (rows, dimension)}
    np.lib.format.write_array_header_1_0(buffer, about)
    return buffer.getvalue()


def _stream_rows(store: ObjectStore, header: bytes, parts: list[_ChunkRows]) -> Iterator[bytes]:
    yield header
    for part in parts:
        if part.rows:
            rows = read_chunk(store, part.object_key, part.sha256)
            for row in part.rows:
                yield rows[row].tobytes()


def _read_blocks(file: IO[bytes]) -> Iterator[bytes]:
    file.seek(0)
    while piece := file.read(STREAM_READ_BYTES):
        yield piece


def _padded_to_block(size_bytes: int) -> int:
    return size_bytes + -size_bytes % tarfile.BLOCKSIZE
