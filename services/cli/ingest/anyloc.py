"""Reader for the photos of an AnyLoc similarity service: a folder and the database `similarity.db`.

The table `images` has one row per photo: `image_id`, `image_path` (on the machine or in the
container where the service ran), `original_filename`, `upload_time` (SQLite's CURRENT_TIMESTAMP:
UTC without an offset), `metadata_json`, `tags`. The other columns describe the service's own
feature files and are not read.

Since `image_path` belongs to another machine and file names are not row ids, rows and files are
matched by the last part of the path.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
import sqlite3
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from itertools import takewhile
from pathlib import Path, PureWindowsPath
from typing import Any

from services.cli.ingest.geotags import LocalPhoto, list_photos
from services.cli.output import Json, utf8_path
from shared.errors import InvalidRequest, PlacewiseError

SQLITE_SUFFIXES = ("", "-wal", "-journal")  # the write-ahead log may contain rows


@dataclass(slots=True)
class AnylocRow:
    """A row of the table `images`, or a photo without one."""

    image_path: str
    name: str
    """The original file name; "" if the row has none."""
    tags: list[str] = field(default_factory=list)
    metadata: Json = field(default_factory=dict)
    """The user's metadata, with `anyloc_image_id` and `anyloc_upload_time` (ISO 8601, UTC)."""


@dataclass(frozen=True, slots=True)
class AnylocPhotos:
    """The photos to upload, and the rows and files that are not."""

    photos: list[LocalPhoto]
    rows: int
    unlisted: int
    """Number of photos without a row."""
    missing: list[Json]
    """Rows whose file was not found: path, filename, reason."""
    duplicates: list[Json]
    """Photos with the same bytes as another one: path, filename, reason."""


def read_anyloc_photos(database: Path, folder: Path) -> AnylocPhotos:
    """Read the photos below a folder with the names, tags and metadata of their rows.

    Raises:
        InvalidRequest: `no_photos`, `bad_anyloc_database`.
    """
    paths = list_photos(folder)
    rows = read_anyloc_rows(database)
    listed, missing = _match_rows_to_files(rows, paths)
    unlisted = sorted(set(paths).difference(path for path, _ in listed))
    found = listed + [(path, AnylocRow("", utf8_path(Path(path.name)))) for path in unlisted]
    photos, duplicates = _drop_duplicates(found)
    return AnylocPhotos(photos, len(rows), len(unlisted), missing, duplicates)


def read_anyloc_rows(database: Path) -> list[AnylocRow]:
    """Read all rows in upload order. Malformed values in a row never fail the import.

    A temporary copy of the database is opened, because SQLite may create write-ahead log files next
    to a database even for reading.

    Raises:
        InvalidRequest: `bad_anyloc_database`.
    """
    try:
        with tempfile.TemporaryDirectory() as folder:
            for suffix in SQLITE_SUFFIXES:
                source = database.with_name(database.name + suffix)
                if source.exists():
                    shutil.copyfile(source, Path(folder, f"copy.db{suffix}"))
            with contextlib.closing(sqlite3.connect(Path(folder, "copy.db"))) as connection:
                return _read_images_table(connection, database)
    except (sqlite3.Error, OSError) as error:
        raise _database_error(database, str(error)) from error


def _read_images_table(connection: sqlite3.Connection, database: Path) -> list[AnylocRow]:
    # SQLite accepts any bytes in a text column: one invalid name must not fail the import.
    connection.text_factory = lambda data: data.decode("utf-8", "replace")
    connection.row_factory = sqlite3.Row
    check_result = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
    if check_result != "ok":
        raise _database_error(database, f"the database is corrupt: {check_result}")
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
    """A value of any SQLite type as stripped text, without NULs, which the server rejects."""
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    return "" if value is None else str(value).replace("\0", "").strip()


def _to_utc(text: str) -> str:
    """Convert to ISO 8601 in UTC; text that is not a time is kept unchanged."""
    try:
        time = datetime.fromisoformat(text)
        return (time if time.tzinfo else time.replace(tzinfo=UTC)).astimezone(UTC).isoformat()
    except (ValueError, OverflowError):
        return text


def _parse_tags(text: str) -> list[str]:
    """Parse a JSON list or comma-separated tags; commas within a tag become spaces."""
    tags: list[Any] = text.split(",")
    if text[:1] in ("[", '"') or text == "null":
        with contextlib.suppress(ValueError, RecursionError):
            value = json.loads(text) or []
            tags = value if isinstance(value, list) else value.split(",")
    cleaned = (" ".join(_clean_text(tag).replace(",", " ").split()) for tag in tags)
    return list(dict.fromkeys(tag for tag in cleaned if tag))


def _parse_metadata(text: str) -> Json:
    """Parse a JSON object; any other text is kept under the key `anyloc_metadata`."""
    if not text:
        return {}
    with contextlib.suppress(ValueError, RecursionError):
        value = json.loads(text, parse_constant=_reject_constant)
        if isinstance(value, dict):
            return value
    return {"anyloc_metadata": text}


def _reject_constant(name: str) -> Any:
    raise ValueError(f"{name} is not valid JSON")


def _database_error(database: Path, reason: str) -> PlacewiseError:
    return InvalidRequest(
        "bad_anyloc_database",
        f"Can't read {database} as an AnyLoc database: {reason}. If the AnyLoc service is still "
        "running, stop it first. To import photos without a database: placewise index DIR.",
    )


def _match_rows_to_files(
    rows: Sequence[AnylocRow], paths: Sequence[Path]
) -> tuple[list[tuple[Path, AnylocRow]], list[Json]]:
    """Return the rows with their files, and a record of each row without one."""
    files: dict[str, list[Path]] = defaultdict(list)
    for path in paths:
        files[path.name].append(path)
    listed: list[tuple[Path, AnylocRow]] = []
    missing: list[Json] = []
    for row in rows:
        recorded = PureWindowsPath(row.image_path)  # accepts / and \ as separators
        if same_name := files.get(recorded.name):
            row.name = row.name or recorded.name
            # Of several files with this name, take the one that shares most parent folders.
            file = max(same_name, key=partial(_common_suffix_length, recorded))
            listed.append((file, row))
        else:
            reason = "the database has a row for this file, but no such photo was found"
            missing.append({"path": row.image_path, "filename": row.name, "reason": reason})
    return listed, missing


def _common_suffix_length(recorded: PureWindowsPath, file: Path) -> int:
    """Number of path parts that are equal, counted from the end."""
    pairs = zip(reversed(file.parts), reversed(recorded.parts), strict=False)
    return len(list(takewhile(lambda pair: pair[0] == pair[1], pairs)))


def _drop_duplicates(
    found: Sequence[tuple[Path, AnylocRow]],
) -> tuple[list[LocalPhoto], list[Json]]:
    """Keep one photo per content; it takes over the tags and metadata of its duplicates."""
    first: dict[object, tuple[Path, AnylocRow]] = {}
    duplicates: list[Json] = []
    keys = _content_keys([path for path, _ in found])
    for key, (path, row) in zip(keys, found, strict=True):
        _, original = first.setdefault(key, (path, row))
        if original is row:
            continue
        original.tags = list(dict.fromkeys(original.tags + row.tags))
        duplicate = {"filename": row.name, **row.metadata}
        original.metadata.setdefault("anyloc_same_photo", []).append(duplicate)
        reason = f"the same photo as {original.name}"
        duplicates.append({"path": utf8_path(path), "filename": row.name, "reason": reason})
    return [_to_local_photo(path, row) for path, row in first.values()], duplicates


def _content_keys(paths: Sequence[Path]) -> Iterator[object]:
    """Yield a key per file that is equal for equal bytes; only files of equal size are read."""
    sizes = [path.stat().st_size for path in paths]
    counts = Counter(sizes)
    for path, size in zip(paths, sizes, strict=True):
        try:
            yield size if counts[size] == 1 else hashlib.sha256(path.read_bytes()).digest()
        except OSError:
            yield path  # its upload fails with the reason


def _to_local_photo(path: Path, row: AnylocRow) -> LocalPhoto:
    fields = {"tags": ",".join(row.tags), "metadata": json.dumps(row.metadata)}
    return LocalPhoto(path, {k: v for k, v in fields.items() if v not in ("", "{}")}, row.name)
