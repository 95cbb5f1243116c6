"""One hostile file, and what may become of it."""

from __future__ import annotations

from dataclasses import dataclass, field

from tests.support.photos import photo_bytes

FORMATS = ("JPEG", "PNG", "WEBP", "BMP", "TIFF")
MAX_BYTES = 500_000  # of a photo, where the corpus is put in
MAX_PIXELS = 1_000_000
MAX_ARCHIVE_BYTES = 5_000_000
MAX_MEMBERS = 50

FINE = frozenset({"succeeded"})
NO_PHOTO = frozenset({"unsupported_photo"})
BROKEN = frozenset({"undecodable_photo", "unsupported_photo"})
TOO_LARGE = frozenset({"too_many_pixels", "undecodable_photo"})
ANYTHING_SAID = FINE | BROKEN | TOO_LARGE
BAD_FIELD = frozenset({"invalid_field"})
OF_ARCHIVES = frozenset(
    {
        "ambiguous_name",
        "bad_manifest",
        "batch_too_large",
        "damaged_archive",
        "damaged_member",
        "empty_file",
        "encrypted_member",
        "file_too_large",
        "invalid_field",
        "manifest_too_large",
        "nested_archive",
        "no_photos",
        "several_manifests",
        "bad_table",
        "succeeded",
        "too_many_photos",
        "too_many_pixels",
        "undecodable_photo",
        "unsupported_archive",
        "unsupported_member",
        "unsupported_photo",
    }
)


@dataclass(frozen=True, slots=True)
class Hostile:
    """One file; `fields` are those of the form beside it."""

    what: str
    data: bytes
    may: frozenset[str]
    filename: str = "photo.jpg"
    fields: dict[str, str] = field(default_factory=dict)
    archive: bool = False


def photo(number: int, media: str = "JPEG") -> bytes:
    """None that two files of the corpus share."""
    return photo_bytes(10_000 + number, media)
