"""From received bytes to a photo that may be stored: checked without decoding a pixel."""

from __future__ import annotations

from dataclasses import dataclass
from uuid import UUID

from shared.intake.photo_fields import PhotoFields, read_form_fields
from shared.intake.photo_header import PhotoHeader, read_photo_header
from shared.intake.received import StoredUpload, check_photo_signature
from shared.objects import ObjectStore


@dataclass(frozen=True, slots=True)
class ValidatedPhoto:
    """A checked photo whose bytes lie in the object store."""

    received: StoredUpload
    media_type: str
    header: PhotoHeader
    fields: PhotoFields
    key_id: UUID | None = None
    """That it came in with."""


def validate_photo(
    store: ObjectStore, upload: StoredUpload, max_pixels: int, key_id: UUID | None = None
) -> ValidatedPhoto:
    """What the photo is and what is said of it.

    Raises UnsupportedMedia (`unsupported_photo`) and Unprocessable (`invalid_field_error`,
    `undecodable_photo`, `too_many_pixels`).
    """
    media_type = check_photo_signature(upload.begin)
    fields = read_form_fields(upload.fields)
    with upload.open(store) as file:
        header = read_photo_header(file, max_pixels)
    return ValidatedPhoto(upload, media_type, header, fields, key_id)
