"""What is learnt of a file while its bytes go into the object store.

From received bytes to a photo that may be stored: checked without decoding a pixel.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import PurePosixPath, PureWindowsPath
from typing import BinaryIO
from uuid import UUID

from shared.errors import PlacewiseError, TooLarge, UnsupportedMedia
from shared.imaging.file_formats import ACCEPTED_PHOTOS, PHOTO_SIGNATURE_BYTES, detect_media_type
from shared.imaging.photo_header import PhotoHeader, read_photo_header
from shared.ingest.photo_metadata import PhotoFields, read_form_fields
from shared.storage import ObjectStore

MAX_NAME_CHARACTERS = 255


@dataclass(slots=True)
class StoredUpload:
    """A file that lies whole under `key` of the object store, and what is said of it."""

    key: str
    filename: str
    size_bytes: int
    sha256: str
    begin: bytes
    """The file's first bytes, as many as tell its format."""
    fields: dict[str, str] = field(default_factory=dict)
    """In the upload form's names."""
    whole: bytes | None = None
    """All of its bytes where they are few, and at hand."""

    def open(self, store: ObjectStore) -> BinaryIO:
        """The file, from memory or from the store."""
        return store.open(self.key) if self.whole is None else io.BytesIO(self.whole)


class StreamValidator:
    """Counts, hashes and checks a file of which only a piece is there at a time."""

    def __init__(
        self,
        max_bytes: int,
        check_begin: Callable[[bytes], object] = lambda begin: None,
        *,
        begin_bytes: int = PHOTO_SIGNATURE_BYTES,
        too_large: Callable[[int], PlacewiseError] | None = None,
    ) -> None:
        """`check_begin` sees the first `begin_bytes` as soon as they are there, and may raise;
        `too_large` makes the refusal of more than `max_bytes`."""
        self.size_bytes = 0
        self.begin = b""
        self._max_bytes = max_bytes
        self._begin_bytes = begin_bytes
        self._too_large = too_large or file_too_large_error
        self._check_begin = check_begin
        self._checked = False
        self._hash = hashlib.sha256()

    @property
    def sha256(self) -> str:
        """Of what has passed, in hexadecimal digits."""
        return self._hash.hexdigest()

    def add(self, piece: bytes) -> None:
        """The next bytes. Raises TooLarge (`file_too_large_error`, unless another refusal was
        given) and what `check_begin` raises."""
        self.size_bytes += len(piece)
        if self.size_bytes > self._max_bytes:
            raise self._too_large(self._max_bytes)
        if len(self.begin) < self._begin_bytes:
            self.begin = (self.begin + piece)[: self._begin_bytes]
        if not self._checked and len(self.begin) == self._begin_bytes:
            self._check_first_bytes()
        self._hash.update(piece)

    def end(self) -> None:
        """That was all: a file shorter than its signature is checked now; an empty one never."""
        if not self._checked and self.size_bytes:
            self._check_first_bytes()

    def _check_first_bytes(self) -> None:
        self._checked = True
        self._check_begin(self.begin)


def check_photo_signature(first_bytes: bytes) -> str:
    """The photo's media type by its content; 415 for anything that is not accepted."""
    media_type = detect_media_type(first_bytes)
    if media_type is None:
        raise UnsupportedMedia(
            "unsupported_photo",
            f"By its content this is not a photo that Placewise reads: send {ACCEPTED_PHOTOS}.",
        )
    return media_type


def base_name(filename: str) -> str:
    """The last part of what someone calls a file, on either kind of system."""
    name = PurePosixPath(PureWindowsPath(filename).name).name
    return "".join(c for c in name if c.isprintable())[:MAX_NAME_CHARACTERS] or "photo"


def file_too_large_error(max_bytes: int) -> PlacewiseError:
    return TooLarge(
        "file_too_large",
        f"The file is larger than {max_bytes} bytes (MAX_FILE_SIZE).",
        max_bytes=max_bytes,
    )


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
