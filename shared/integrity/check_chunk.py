"""One chunk against its hash, its manifest and the catalog's rows."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from uuid import UUID

from shared.chunks import are_whole, decode_rows, manifest_key
from shared.errors import NotFound
from shared.integrity.report import Fault, Report, Wrong
from shared.objects import ObjectStore


def check_chunk(
    store: ObjectStore,
    chunk_id: UUID,
    object_key: str,
    sha256: str,
    rows: int,
    placed: list[tuple[int, UUID]],
    report: Report,
) -> Iterator[Fault]:
    """What is wrong with the chunk; `placed` is the row of each of its photos by the catalog."""
    manifest = manifest_key(object_key)
    try:
        data = store.get(object_key)
    except NotFound:
        yield Fault(Wrong.MISSING, "chunk", object_key, "it is not in the store", chunk_id)
        return
    report.checked["chunk"] += 1
    report.read_bytes += len(data)
    if hashlib.sha256(data).hexdigest() != sha256:
        yield Fault(Wrong.DAMAGED, "chunk", object_key, "its hash differs", chunk_id)
        return
    found = decode_rows(data)
    if len(found) != rows or not are_whole(found).all():
        detail = f"it has {len(found)} rows of {rows}, or rows that are no unit vectors"
        yield Fault(Wrong.DIFFERENT, "chunk", object_key, detail, chunk_id)
        return
    try:
        said = json.loads(store.get(manifest))
        photo_ids = [UUID(photo_id) for photo_id in said["photo_ids"]]
        fits = said["sha256"] == sha256 and len(photo_ids) == rows
    except NotFound:
        yield Fault(Wrong.MISSING, "manifest", manifest, "it is not in the store", chunk_id)
        return
    except (ValueError, KeyError, TypeError, AttributeError):
        yield Fault(Wrong.DAMAGED, "manifest", manifest, "it can't be read", chunk_id)
        return
    report.checked["manifest"] += 1
    if not fits:
        yield Fault(Wrong.DIFFERENT, "manifest", manifest, "it is of another chunk", chunk_id)
        return
    astray = [
        photo_id for row, photo_id in placed if not 0 <= row < rows or photo_ids[row] != photo_id
    ]
    if astray:
        detail = f"{len(astray)} photos have another row by the catalog, the first is {astray[0]}"
        yield Fault(Wrong.DIFFERENT, "chunk", object_key, detail, chunk_id)
