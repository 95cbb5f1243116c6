"""A generation's descriptors into a folder."""

from __future__ import annotations

import shutil
import tarfile
import tempfile
from pathlib import Path
from uuid import UUID

import numpy as np
from rich.progress import Progress

from services.cli.output import printable_path
from services.cli.whole_file import atomic_write
from shared.client import Client, Json
from shared.errors import Conflict, InvalidRequest, Misconfigured

EXPORTED_FILES = ("photos.csv", "names.txt", "descriptors.npy")


def export_descriptors(
    client: Client, out: Path, generation_id: str | None, progress: Progress
) -> Json:
    """Write FILES into the folder; each is whole or not there.

    Raises InvalidRequest (`bad_id`), Conflict (`nothing_described`), NotFound, Misconfigured
    (`out_unwritable`).
    """
    chosen = (
        _validate_generation_id(generation_id) if generation_id else _active_generation_id(client)
    )
    receiving = progress.add_task("receiving (bytes)", total=None)
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out) as received:
            client.export_descriptors(
                chosen, received, lambda size: progress.update(receiving, completed=size)
            )
            received.seek(0)
            with tarfile.open(fileobj=received, mode="r:") as tar:
                for name in EXPORTED_FILES:
                    member = tar.extractfile(name)
                    assert member is not None, "the server sends files"
                    with member, atomic_write(out / name) as file:
                        shutil.copyfileobj(member, file)
    except OSError as error:
        raise Misconfigured(
            "out_unwritable", f"{printable_path(out)} can't be written: {error.strerror}."
        ) from error
    rows = np.load(out / "descriptors.npy", mmap_mode="r")
    return {
        "file": printable_path(out / "descriptors.npy"),
        "generation_id": chosen,
        "rows": rows.shape[0],
        "dimension": rows.shape[1],
    }


def _active_generation_id(client: Client) -> str:
    for one in client.generations():
        if one["state"] == "active":
            return str(one["generation_id"])
    raise Conflict(
        "nothing_described", "The map has no described photo yet. Upload some: placewise index."
    )


def _validate_generation_id(generation_id: str) -> str:
    """What is no id would be another path."""
    try:
        return str(UUID(generation_id))
    except ValueError:
        raise InvalidRequest("bad_id", f"{generation_id!r} is no generation's id.") from None
