"""A generation's descriptors into a folder."""

from __future__ import annotations

import shutil
import tarfile
import tempfile
from pathlib import Path
from uuid import UUID

import numpy as np
from rich.progress import Progress

from services.cli.output import shown
from services.cli.whole_file import whole_or_nothing
from shared.client import Client, Json
from shared.errors import Conflict, InvalidRequest, Misconfigured

FILES = ("photos.csv", "names.txt", "descriptors.npy")


def export_descriptors(
    client: Client, out: Path, generation_id: str | None, progress: Progress
) -> Json:
    """Write FILES into the folder; each is whole or not there.

    Raises InvalidRequest (`bad_id`), Conflict (`nothing_described`), NotFound, Misconfigured
    (`out_unwritable`).
    """
    chosen = _checked(generation_id) if generation_id else _active(client)
    receiving = progress.add_task("receiving (bytes)", total=None)
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out) as received:
            client.export_descriptors(
                chosen, received, lambda size: progress.update(receiving, completed=size)
            )
            received.seek(0)
            with tarfile.open(fileobj=received, mode="r:") as tar:
                for name in FILES:
                    member = tar.extractfile(name)
                    assert member is not None, "the server sends files"
                    with member, whole_or_nothing(out / name) as file:
                        shutil.copyfileobj(member, file)
    except OSError as error:
        raise Misconfigured(
            "out_unwritable", f"{shown(out)} can't be written: {error.strerror}."
        ) from error
    rows = np.load(out / "descriptors.npy", mmap_mode="r")
    return {
        "file": shown(out / "descriptors.npy"),
        "generation_id": chosen,
        "rows": rows.shape[0],
        "dimension": rows.shape[1],
    }


def _active(client: Client) -> str:
    for one in client.generations():
        if one["state"] == "active":
            return str(one["generation_id"])
    raise Conflict(
        "nothing_described", "The map has no described photo yet. Upload some: placewise index."
    )


def _checked(generation_id: str) -> str:
    """What is no id would be another path."""
    try:
        return str(UUID(generation_id))
    except ValueError:
        raise InvalidRequest("bad_id", f"{generation_id!r} is no generation's id.") from None
