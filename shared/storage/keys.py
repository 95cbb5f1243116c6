"""Keys of the object store; `shared.storage.chunks` defines those of chunks."""

from __future__ import annotations

import re
from datetime import date
from uuid import UUID

from shared.errors import NotFound
from shared.ids import new_id

OWNER_MARK = ".placewise"  # the note with the id of the owner (`shared.storage.ownership`)

CHECKPOINTS = "checkpoints/"
JOURNAL = "journal/"
MODELS = "models/"
ORIGINALS = "originals/"
PREVIEWS = "previews/"
QUERIES = "queries/"
RECONSTRUCTIONS = "reconstructions/"
THUMBNAILS = "thumbnails/"
TRASH = "trash/"
VOCABULARIES = "vocabularies/"
WHITENINGS = "whitenings/"

IMPORTS = "imports/"
"""Objects of the operator, which batches may import. Placewise only reads them."""


def is_valid_key(key: str) -> bool:
    """Return whether the key is portable between all stores.

    A valid key consists of names joined by single slashes, none of them `.` or `..`, without NUL
    and without backslash (which some S3 servers treat as a slash).
    """
    return not any(part in ("", ".", "..") for part in key.split("/")) and not set(key) & set(
        "\0\\"
    )


def check_key(key: str) -> str:
    """Return the key; ValueError where it is not valid."""
    if not is_valid_key(key):
        raise ValueError(f"not an object key: {key!r}")
    return key


def check_note_name(name: str) -> str:
    """Return the name of a note; ValueError where it is not valid."""
    if not name.startswith(OWNER_MARK) or not is_valid_key(name) or "/" in name:
        raise ValueError(f"not the name of a note: {name!r}")
    return name


def object_not_found_error(key: str) -> NotFound:
    return NotFound("object_not_found", f"The object store has no object {key!r}.", key=key)


def trash_key(key: str, day: date) -> str:
    """Return the key of an object that was moved to the trash on this day (UTC)."""
    return f"{TRASH}{day.isoformat()}/{key}"


def key_before_trash(trashed: str) -> str:
    """Return the original key of an object in the trash; ValueError for any other key."""
    _, _, key = trashed.removeprefix(TRASH).partition("/")
    if not trashed.startswith(TRASH) or not key:
        raise ValueError(f"not the key of an object in the trash: {trashed!r}")
    return key


def new_original_key(suffix: str = "") -> str:
    """Return a new key for an uploaded photo; file names of users never become keys.

    Args:
        suffix: Ending of the file, such as `.jpg` (`shared.imaging.file_formats.photo_suffix`), so
            that other programs open the files of UPLOAD_DIR.
    """
    return f"{ORIGINALS}{new_id()}{suffix}"


def is_original_key(key: str) -> bool:
    """Return whether `new_original_key` created the key.

    Operators may put other files into UPLOAD_DIR. Those of the AnyLoc similarity service are named
    by a random UUID and a suffix; ours with a suffix have a UUIDv7.
    """
    name, dot, suffix = key.removeprefix(ORIGINALS).partition(".")
    try:
        photo_id = UUID(name)
    except ValueError:
        return False
    is_ours = not dot or (photo_id.version == 7 and re.fullmatch("[a-z]{3,4}", suffix) is not None)
    return is_ours and key == f"{ORIGINALS}{photo_id}{dot}{suffix}"


def thumbnail_key(photo_id: UUID) -> str:
    return f"{THUMBNAILS}{photo_id}.jpg"


def preview_key(photo_id: UUID) -> str:
    return f"{PREVIEWS}{photo_id}.jpg"


def derived_image_keys(photo_id: UUID) -> tuple[str, ...]:
    """Return the keys of all images that are made of a photo; some may not exist."""
    return thumbnail_key(photo_id), preview_key(photo_id)


def query_key(job_id: UUID) -> str:
    """Return the key of a query photo that is not stored."""
    return f"{QUERIES}{job_id}"


def query_vector_key(job_id: UUID) -> str:
    """Return the key of a query photo's descriptor, a chunk of one row."""
    return f"{QUERIES}{job_id}.npy"


def query_features_key(job_id: UUID) -> str:
    """Return the key of a query photo's local features, a feature file of one row."""
    return f"{QUERIES}{job_id}.features"


def query_preview_key(job_id: UUID) -> str:
    """Return the key of a query photo's preview, JPEG, if browsers need one."""
    return f"{QUERIES}{job_id}.jpg"


def query_object_keys(job_id: UUID) -> tuple[str, ...]:
    """Return the keys of all objects that a query may have."""
    return (
        query_key(job_id),
        query_vector_key(job_id),
        query_features_key(job_id),
        query_preview_key(job_id),
    )


def reconstruction_prefix(reconstruction_id: UUID) -> str:
    """Return the beginning of the keys of a reconstruction's objects."""
    return f"{RECONSTRUCTIONS}{reconstruction_id}/"


def matches_key(reconstruction_id: UUID) -> str:
    return f"{reconstruction_prefix(reconstruction_id)}matches.npz"


def component_key(reconstruction_id: UUID, number: int) -> str:
    """Return the key of a component; its COLMAP model is in the folder of the same name."""
    return f"{reconstruction_prefix(reconstruction_id)}{number}.npz"


def new_vocabulary_key() -> str:
    return f"{VOCABULARIES}{new_id()}.npy"


def new_whitening_key() -> str:
    return f"{WHITENINGS}{new_id()}.safetensors"


def new_checkpoint_key() -> str:
    """Return a new key for a checkpoint that was uploaded to be added as a model."""
    return f"{CHECKPOINTS}{new_id()}"


def new_model_key(sha256: str) -> str:
    """Return a new key for a model file with this hash.

    A key is never reused, so that garbage collection can't delete a model that was added again.
    """
    return f"{MODELS}{sha256}/{new_id()}.safetensors"
