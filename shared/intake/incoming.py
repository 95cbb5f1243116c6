"""From received bytes to a photo that may be stored: checked without decoding a pixel."""

from __future__ import annotations

from dataclasses import dataclass
from uuid import UUID

from shared.intake.photo_fields import PhotoFields, read_form_fields
from shared.intake.photo_header import PhotoHeader, read_photo_header
from shared.intake.received import Received, check_photo_begin
from shared.objects import ObjectStore


@dataclass(frozen=True, slots=True)
class Incoming:
    """A checked photo whose bytes lie in the object store."""

    received: Received
    media_type: str
    header: PhotoHeader
    fields: PhotoFields
    key_id: UUID | None = None
    """That it came in with."""


def examine(
    store: ObjectStore, received: Received, max_pixels: int, key_id: UUID | None = None
) -> Incoming:
    """What the photo is and what is said of it.

    Raises UnsupportedMedia (`unsupported_photo`) and Unprocessable (`invalid_field`,
    `undecodable_photo`, `too_many_pixels`).
    """
    media_type = check_photo_begin(received.begin)
    fields = read_form_fields(received.fields)
    with received.open(store) as file:
        header = read_photo_header(file, max_pixels)
    return Incoming(received, media_type, header, fields, key_id)
