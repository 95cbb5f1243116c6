"""One chunk against its hash, its manifest and the catalog's rows."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from uuid import UUID

from shared.chunks import decode_rows, manifest_key, rows_are_valid
from shared.errors import NotFound
from shared.integrity.report import FaultKind, IntegrityFault, IntegrityReport
from shared.objects import ObjectStore


def verify_chunk(
    store: ObjectStore,
    chunk_id: UUID,
    object_key: str,
    sha256: str,
    rows: int,
    catalog_rows: list[tuple[int, UUID]],
    report: IntegrityReport,
) -> Iterator[IntegrityFault]:
    """What is wrong with the chunk; `catalog_rows` is the row of each of its photos by the catalog."""
    manifest = manifest_key(object_key)
    try:
        data = store.get(object_key)
    except NotFound:
        yield IntegrityFault(
            FaultKind.MISSING, "chunk", object_key, "it is not in the store", chunk_id
        )
        return
    report.checked["chunk"] += 1
    report.read_bytes += len(data)
    if hashlib.sha256(data).hexdigest() != sha256:
        yield IntegrityFault(FaultKind.DAMAGED, "chunk", object_key, "its hash differs", chunk_id)
        return
    found = decode_rows(data)
    if len(found) != rows or not rows_are_valid(found).all():
        detail = f"it has {len(found)} rows of {rows}, or rows that are no unit vectors"
        yield IntegrityFault(FaultKind.DIFFERENT, "chunk", object_key, detail, chunk_id)
        return
    try:
        said = json.loads(store.get(manifest))
        photo_ids = [UUID(photo_id) for photo_id in said["photo_ids"]]
        fits = said["sha256"] == sha256 and len(photo_ids) == rows
    except NotFound:
        yield IntegrityFault(
            FaultKind.MISSING, "manifest", manifest, "it is not in the store", chunk_id
        )
        return
    except (ValueError, KeyError, TypeError, AttributeError):
        yield IntegrityFault(FaultKind.DAMAGED, "manifest", manifest, "it can't be read", chunk_id)
        return
    report.checked["manifest"] += 1
    if not fits:
        yield IntegrityFault(
            FaultKind.DIFFERENT, "manifest", manifest, "it is of another chunk", chunk_id
        )
        return
    astray = [
        photo_id
        for row, photo_id in catalog_rows
        if not 0 <= row < rows or photo_ids[row] != photo_id
    ]
    if astray:
        detail = f"{len(astray)} photos have another row by the catalog, the first is {astray[0]}"
        yield IntegrityFault(FaultKind.DIFFERENT, "chunk", object_key, detail, chunk_id)
