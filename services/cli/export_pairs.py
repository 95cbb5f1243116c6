"""Retrieval pairs as hloc reads them: two names a line, the best match of a photo first."""

from __future__ import annotations

from collections import Counter
from enum import StrEnum
from typing import BinaryIO

from rich.progress import Progress

from shared.client import Client, Json
from shared.errors import Conflict, InvalidRequest


class PairNames(StrEnum):
    FILENAME = "filename"
    ID = "id"


def export_pairs(
    client: Client, file: BinaryIO, top_k: int, names: PairNames, progress: Progress
) -> Json:
    """Ask with each labelled query, or with every photo where there is none.

    Returns counts: `asked`, `pairs`, and `passed_over` of photos that are not described. Raises
    Conflict (`no_photos`), InvalidRequest (`ambiguous_names`: two photos of one name, or a name
    with a space, which hloc's format has no way to write).
    """
    photos = list(client.each("/search", "images"))
    if names == PairNames.FILENAME:
        _check_unique_names(photos)
    asked = [one for one in photos if one["role"] == "query"] or photos
    if not asked:
        raise Conflict("no_photos", "The map has no photos yet. Upload some: placewise index.")
    asking = progress.add_task("asking", total=len(asked))
    pairs = passed_over = 0
    for photo in asked:
        try:
            found = client.similar_to(photo["image_id"], top_k=top_k)["similar_images"]
        except Conflict as error:
            if error.code != "not_searchable":
                raise
            passed_over += 1
            found = []
        for match in found:
            file.write(f"{_photo_name(photo, names)} {_photo_name(match, names)}\n".encode())
            pairs += 1
        progress.advance(asking)
    return {"asked": len(asked), "pairs": pairs, "passed_over": passed_over}


def _photo_name(photo: Json, names: PairNames) -> str:
    return str(photo["original_filename" if names == PairNames.FILENAME else "image_id"])


def _check_unique_names(photos: list[Json]) -> None:
    times = Counter(photo["original_filename"] for photo in photos)
    bad = [name for name, count in times.items() if count > 1 or name.split() != [name]]
    if bad:
        raise InvalidRequest(
            "ambiguous_names",
            f"{len(bad)} names stand for several photos, or have a space: {bad[0]!r}. Call photos "
            "by their ids: --names id.",
        )
