"""Where things lie in the object store; `shared.storage.chunks` names its own keys."""

from __future__ import annotations

from datetime import date
from uuid import UUID

from shared.errors import Misconfigured
from shared.ids import new_id

INCOMING = "incoming/"
ARCHIVES = "archives/"
CHECKPOINTS = "checkpoints/"
FEATURES = "features/"
JOURNAL = "journal/"
MODELS = "models/"
ORIGINALS = "originals/"
QUERIES = "queries/"
THUMBNAILS = "thumbnails/"
TRASH = "trash/"
VOCABULARIES = "vocabularies/"
WHITENINGS = "whitenings/"
WORK = "work/"

OWN_PREFIXES = (
    ARCHIVES,
    CHECKPOINTS,
    "chunks/",
    FEATURES,
    JOURNAL,
    MODELS,
    ORIGINALS,
    QUERIES,
    THUMBNAILS,
    TRASH,
    VOCABULARIES,
    WHITENINGS,
    WORK,
)


def is_valid_key(key: str) -> bool:
    """Is it names joined by single slashes, none of them `.` or `..`, without NUL and backslash
    (which some S3 servers take for a slash)? Such a key means the same in every store."""
    return not any(part in ("", ".", "..") for part in key.split("/")) and not set(key) & set(
        "\0\\"
    )


def check_key(key: str) -> str:
    """The key itself; ValueError where it is none."""
    if not is_valid_key(key):
        raise ValueError(f"not an object key: {key!r}")
    return key


def trash_key(key: str, day: date) -> str:
    """Where an object lies that was moved to the trash on this day (UTC)."""
    return f"{TRASH}{day.isoformat()}/{key}"


def key_before_trash(trashed: str) -> str:
    """The key that an object of the trash had before. ValueError for no key of `trash_key`."""
    _, _, key = trashed.removeprefix(TRASH).partition("/")
    if not trashed.startswith(TRASH) or not key:
        raise ValueError(f"not a key of the trash: {trashed!r}")
    return key


def new_archive_key() -> str:
    """A fresh key for an archive that a batch brings its photos from."""
    return f"{ARCHIVES}{new_id()}"


def check_import_prefix(prefix: str) -> None:
    """Misconfigured (`bad_setting`) unless the prefix is a folder, and none of Placewise's own."""
    if not prefix.endswith("/") or not is_valid_key(prefix[:-1]) or prefix.startswith("."):
        raise Misconfigured(
            "bad_setting",
            f"IMPORT_PREFIX is {prefix!r}; it is a folder of the object store, such as imports/.",
        )
    if prefix.startswith(OWN_PREFIXES):
        raise Misconfigured(
            "bad_setting",
            f"IMPORT_PREFIX is {prefix!r}, and there lies what belongs to Placewise. Take another "
            f"folder than {', '.join(OWN_PREFIXES)}.",
        )


def new_original_key() -> str:
    """A fresh key for an upload; user file names never become keys."""
    return f"{ORIGINALS}{new_id()}"


def incoming_key(upload_id: UUID) -> str:
    """Where a caller puts the bytes of a direct upload; completing it copies them."""
    return f"{INCOMING}{upload_id}"


def is_original_key(key: str) -> bool:
    """Was it made by `new_original_key`? UPLOAD_DIR is a folder into which people may put files."""
    try:
        return key == f"{ORIGINALS}{UUID(key.removeprefix(ORIGINALS))}"
    except ValueError:
        return False


def thumbnail_key(photo_id: UUID) -> str:
    return f"{THUMBNAILS}{photo_id}.jpg"


def query_key(job_id: UUID) -> str:
    """The bytes of a query photo that is not stored."""
    return f"{QUERIES}{job_id}"


def query_vector_key(job_id: UUID) -> str:
    """Its descriptor: a chunk of one row."""
    return f"{QUERIES}{job_id}.npy"


def comparison_key(job_id: UUID) -> str:
    """What a comparison has come to: the JSON of a `shared.search_api.comparison.CompareResult`."""
    return f"{QUERIES}{job_id}.json"


def query_object_keys(job_id: UUID) -> tuple[str, ...]:
    """All that lies there of a query, or of a comparison."""
    return query_key(job_id), query_vector_key(job_id), comparison_key(job_id)


def local_features_prefix(generation_id: UUID) -> str:
    """Where the local features of a generation's photos lie."""
    return f"{FEATURES}{generation_id}/"


def local_features_key(generation_id: UUID, photo_id: UUID) -> str:
    return f"{local_features_prefix(generation_id)}{photo_id}.npy"


def new_vocabulary_key() -> str:
    return f"{VOCABULARIES}{new_id()}.npy"


def new_whitening_key() -> str:
    return f"{WHITENINGS}{new_id()}.safetensors"


def new_checkpoint_key() -> str:
    """A fresh key for a checkpoint that was sent to be added as a model."""
    return f"{CHECKPOINTS}{new_id()}"


def new_model_key(sha256: str) -> str:
    """A fresh key for a model's file of this hash. Fresh, so that looking for orphans never meets
    one that comes back under its old key."""
    return f"{MODELS}{sha256}/{new_id()}.safetensors"


def job_work_key(job_id: UUID, name: str) -> str:
    """What a sliced job keeps between its slices."""
    return f"{WORK}{job_id}/{name}"
