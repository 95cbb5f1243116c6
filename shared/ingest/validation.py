"""Validation of uploads: size, hash, signature and header, without decoding any pixels."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import PurePosixPath, PureWindowsPath
from typing import BinaryIO
from uuid import UUID

from shared.config.values import format_megabytes
from shared.errors import PlacewiseError, TooLarge, UnsupportedMedia
from shared.imaging.file_formats import (
    ACCEPTED_PHOTOS,
    ARCHIVE_SIGNATURES,
    PHOTO_SIGNATURE_BYTES,
    detect_media_type,
)
from shared.imaging.photo_header import PhotoHeader, read_photo_header
from shared.ingest.photo_metadata import PhotoFields, read_form_fields
from shared.storage import ObjectStore
from shared.storage.copying import hash_file

MAX_NAME_CHARACTERS = 255


@dataclass(slots=True)
class StoredUpload:
    """A completely received file in the object store, with its form fields."""

    key: str
    filename: str
    size_bytes: int
    sha256: str
    first_bytes: bytes
    """The file's first bytes, enough to detect its format."""
    fields: dict[str, str] = field(default_factory=dict)
    """Values by the names of the upload form."""
    content: bytes | None = None
    """The whole file, if it is small and still in memory."""

    @classmethod
    def read(cls, store: ObjectStore, key: str, filename: str) -> StoredUpload:
        """Read a stored object. NotFound when it is missing."""
        with store.open(key) as file:
            first_bytes = file.read(PHOTO_SIGNATURE_BYTES)
            file.seek(0)
            size_bytes, sha256 = hash_file(file)
        return cls(key, filename, size_bytes, sha256, first_bytes)

    def open(self, store: ObjectStore) -> BinaryIO:
        """Open the bytes of the upload: `content` if they are in memory, else the stored object."""
        return store.open(self.key) if self.content is None else io.BytesIO(self.content)


class StreamValidator:
    """Counts, hashes and checks a file block by block."""

    def __init__(
        self,
        max_bytes: int,
        check_signature: Callable[[bytes], object] = lambda first_bytes: None,
        *,
        too_large: Callable[[int], PlacewiseError] | None = None,
    ) -> None:
        """
        Args:
            max_bytes: size limit.
            check_signature: called with the first PHOTO_SIGNATURE_BYTES as soon as they have
                arrived; it may raise.
            too_large: returns the error for a file larger than `max_bytes`.
        """
        self.size_bytes = 0
        self.first_bytes = b""
        self._max_bytes = max_bytes
        self._too_large = too_large or file_too_large_error
        self._check_signature = check_signature
        self._checked = False
        self._hash = hashlib.sha256()

    @property
    def sha256(self) -> str:
        """Hash of the bytes so far, hexadecimal."""
        return self._hash.hexdigest()

    def add(self, block: bytes) -> None:
        """Process the next bytes.

        Raises TooLarge (`file_too_large`, unless `too_large` returns another error) and what
        `check_signature` raises.
        """
        self.size_bytes += len(block)
        if self.size_bytes > self._max_bytes:
            raise self._too_large(self._max_bytes)
        if len(self.first_bytes) < PHOTO_SIGNATURE_BYTES:
            self.first_bytes = (self.first_bytes + block)[:PHOTO_SIGNATURE_BYTES]
        if not self._checked and len(self.first_bytes) == PHOTO_SIGNATURE_BYTES:
            self._check_first_bytes()
        self._hash.update(block)

    def end(self) -> None:
        """End the file: check one that is shorter than the signature, unless it is empty."""
        if not self._checked and self.size_bytes:
            self._check_first_bytes()

    def _check_first_bytes(self) -> None:
        self._checked = True
        self._check_signature(self.first_bytes)


def check_photo_signature(first_bytes: bytes) -> str:
    """Return the photo's media type by its content; UnsupportedMedia (`unsupported_photo`)."""
    media_type = detect_media_type(first_bytes)
    if media_type is None:
        what = "is not a photo in a supported format"
        advice = f"Send {ACCEPTED_PHOTOS}."
        if first_bytes.startswith(ARCHIVE_SIGNATURES):
            what, advice = "is an archive", "Unpack it, or run placewise index ARCHIVE."
        raise UnsupportedMedia("unsupported_photo", f"The file {what}. {advice}")
    return media_type


def base_name(filename: str) -> str:
    """Return the last component of a POSIX or Windows path, without unprintable characters."""
    name = PurePosixPath(PureWindowsPath(filename).name).name
    return "".join(c for c in name if c.isprintable())[:MAX_NAME_CHARACTERS] or "photo"


def file_too_large_error(max_bytes: int) -> PlacewiseError:
    """Return the error for a file larger than MAX_FILE_SIZE."""
    return TooLarge(
        "file_too_large",
        f"The photo is larger than {format_megabytes(max_bytes)}, the limit of this server. Its "
        "administrator can raise the limit: MAX_FILE_SIZE in the environment of the server, or in "
        "the file .env of the folder where it starts.",
        max_bytes=max_bytes,
    )


@dataclass(frozen=True, slots=True)
class ValidatedPhoto:
    """A validated photo whose bytes are in the object store."""

    received: StoredUpload
    media_type: str
    header: PhotoHeader
    fields: PhotoFields
    key_id: UUID | None = None
    """The API key of the upload."""
    picture_sha256: str | None = None
    """Hash of path and picture without metadata; None if the picture's bytes are unknown."""


def validate_photo(
    store: ObjectStore,
    upload: StoredUpload,
    max_pixels: int,
    key_id: UUID | None = None,
) -> ValidatedPhoto:
    """Validate a photo's signature, form fields and header.

    Raises:
        UnsupportedMedia: `unsupported_photo`.
        Unprocessable: `invalid_field`, `undecodable_photo`, `too_many_pixels`.
    """
    media_type = check_photo_signature(upload.first_bytes)
    fields = read_form_fields(upload.fields)
    with upload.open(store) as file:
        header = read_photo_header(file, max_pixels)
        path = fields.relative_path or upload.filename
        picture_sha256 = header.picture.sha256(file, path) if header.picture else None
    return ValidatedPhoto(upload, media_type, header, fields, key_id, picture_sha256)
