"""Reading the predecessor's catalog: `similarity.db` of the AnyLoc similarity service.

Its table `images` has a row per photo: `image_id`, `image_path` (of the machine that it ran on),
`original_filename`, `upload_time` (SQLite's CURRENT_TIMESTAMP: UTC without saying so),
`metadata_json`, `tags`; the other columns are about its own feature files.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import sqlite3
import tempfile
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from shared.errors import InvalidRequest, PlacewiseError

DATABASE_NAME = "similarity.db"
SQLITE_SUFFIXES = ("", "-wal", "-journal")  # rows may still lie in its write-ahead log


@dataclass(frozen=True, slots=True)
class AnylocRow:
    """One photo as the predecessor knew it."""

    image_path: str
    name: str
    """What its user called it; "" where that was not kept."""
    tags: list[str]
    metadata: dict[str, Any]
    """The user's, with `anyloc_image_id` and `anyloc_upload_time` (ISO 8601, UTC)."""


def read_anyloc_rows(database: Path) -> list[AnylocRow]:
    """Every row of the table, in the order of the uploads; whatever is in a row can be read.

    Nothing is written beside the database: even to read, SQLite would make files for its
    write-ahead log there, so a copy is opened. Raises InvalidRequest (`bad_anyloc_database`).
    """
    try:
        with tempfile.TemporaryDirectory() as folder:
            for ending in SQLITE_SUFFIXES:
                source = database.with_name(database.name + ending)
                if source.exists():
                    shutil.copyfile(source, Path(folder, DATABASE_NAME + ending))
            with contextlib.closing(sqlite3.connect(Path(folder, DATABASE_NAME))) as connection:
                return _read_images_table(connection, database)
    except (sqlite3.Error, OSError) as error:
        raise _database_error(database, str(error)) from error


def _read_images_table(connection: sqlite3.Connection, database: Path) -> list[AnylocRow]:
    # It lets any bytes into a text column, and one bad name must not cost the other photos.
    connection.text_factory = lambda data: data.decode("utf-8", "replace")
    connection.row_factory = sqlite3.Row
    found = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
    if found != "ok":
        raise _database_error(database, f"it is damaged: {found}")
    return [
        _parse_row(dict(row)) for row in connection.execute("SELECT * FROM images ORDER BY rowid")
    ]


def _parse_row(row: dict[str, Any]) -> AnylocRow:
    metadata = _parse_metadata(_clean_text(row.get("metadata_json")))
    if image_id := _clean_text(row.get("image_id")):
        metadata["anyloc_image_id"] = image_id
    if uploaded := _clean_text(row.get("upload_time")):
        metadata["anyloc_upload_time"] = _to_utc(uploaded)
    return AnylocRow(
        image_path=_clean_text(row.get("image_path")),
        name=_clean_text(row.get("original_filename")),
        tags=_parse_tags(_clean_text(row.get("tags"))),
        metadata=metadata,
    )


def _clean_text(value: object) -> str:
    """SQLite's columns take values of any type; a NUL can't be stored again."""
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    return "" if value is None else str(value).replace("\0", "").strip()


def _to_utc(text: str) -> str:
    """As it stands where it is no time: better odd than lost."""
    try:
        time = datetime.fromisoformat(text)
        return (time if time.tzinfo else time.replace(tzinfo=UTC)).astimezone(UTC).isoformat()
    except (ValueError, OverflowError):
        return text


def _parse_tags(text: str) -> list[str]:
    """A JSON list, or words separated by commas; the upload form separates tags by commas."""
    tags: list[Any] = text.split(",")
    if text[:1] in ("[", '"') or text == "null":
        with contextlib.suppress(ValueError, RecursionError):
            value = json.loads(text) or []
            tags = value if isinstance(value, list) else value.split(",")
    cleaned = (" ".join(_clean_text(tag).replace(",", " ").split()) for tag in tags)
    return list(dict.fromkeys(tag for tag in cleaned if tag))


def _parse_metadata(text: str) -> dict[str, Any]:
    """The JSON object; what is none is kept as it stands, as `anyloc_metadata`."""
    if not text:
        return {}
    with contextlib.suppress(ValueError, RecursionError):
        value = json.loads(text, parse_constant=_reject_constant)
        if isinstance(value, dict):
            return value
    return {"anyloc_metadata": text}


def _reject_constant(name: str) -> Any:
    raise ValueError(f"{name} is not JSON, though Python writes it")


def _database_error(database: Path, reason: str) -> PlacewiseError:
    return InvalidRequest(
        "bad_anyloc_database",
        f"Can't read {database} as the predecessor's database: {reason}. If the predecessor still "
        "runs, stop it first. Photos without a database: placewise index DIR.",
    )
