"""Reader for the folder of an AnyLoc similarity service: its SQLite database and its photos.

The table `images` of `similarity.db` has one row per photo: `image_id`, `image_path` (on the
machine or in the container where the service ran), `original_filename`, `upload_time` (SQLite's
CURRENT_TIMESTAMP: UTC without an offset), `metadata_json`, `tags`. The other columns describe the
service's own feature files and are not read.

Since `image_path` belongs to another machine and file names are not row ids, rows and files are
matched by the last part of the path, below a folder named `uploads`.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import sqlite3
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import takewhile
from pathlib import Path, PureWindowsPath
from typing import Any

from services.cli.ingest.geotags import LocalPhoto
from services.cli.output import Json, utf8_path
from shared.errors import InvalidRequest, PlacewiseError
from shared.imaging.file_formats import PHOTO_SUFFIXES

DATABASE_NAME = "similarity.db"
SQLITE_SUFFIXES = ("", "-wal", "-journal")  # the write-ahead log may contain rows


@dataclass(frozen=True, slots=True)
class AnylocRow:
    """A row of the table `images`."""

    image_path: str
    name: str
    """The original file name; "" if the row has none."""
    tags: list[str]
    metadata: dict[str, Any]
    """The user's metadata, with `anyloc_image_id` and `anyloc_upload_time` (ISO 8601, UTC)."""


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
                    shutil.copyfile(source, Path(folder, DATABASE_NAME + suffix))
            with contextlib.closing(sqlite3.connect(Path(folder, DATABASE_NAME))) as connection:
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


def _parse_metadata(text: str) -> dict[str, Any]:
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


UPLOADS_FOLDER = "uploads"
VOCABULARY_FILE = "c_centers.pt"


@dataclass(slots=True)
class AnylocPhoto:
    """A photo file with the metadata of its row, if any."""

    path: Path
    name: str
    tags: list[str] = field(default_factory=list)
    metadata: dict[str, Any] = field(default_factory=dict)

    def to_local_photo(self) -> LocalPhoto:
        """Convert to the form fields of `POST /upload`."""
        fields = {"tags": ",".join(self.tags), "metadata": json.dumps(self.metadata)}
        return LocalPhoto(
            self.path, {k: v for k, v in fields.items() if v not in ("", "{}")}, self.name
        )


@dataclass(slots=True)
class AnylocFolder:
    """The photos to import, and the rows and files that are not imported."""

    database: Path
    rows: int
    photos: list[LocalPhoto]
    unlisted: int
    """Number of photos without a row."""
    missing: list[Json]
    """Rows whose file was not found: path, filename, reason."""
    duplicates: list[Json]
    """Photos with the same bytes as an imported one: path, filename, reason."""
    vocabularies: list[Path]
    """Vocabulary files found, which are not imported."""


def read_anyloc_folder(folder: Path, database: Path | None, uploads: Path | None) -> AnylocFolder:
    """Read the database and match its rows with the photo files.

    Args:
        folder: Folder of the AnyLoc service, or a parent of it.
        database: Path of `similarity.db`; by default searched below `folder`.
        uploads: Folder of the photos; by default searched below `folder`.

    Raises:
        InvalidRequest: `no_anyloc_database`, `several_anyloc_databases`, `no_anyloc_uploads`,
            `bad_anyloc_database`.
    """
    all_files = list(_list_files(folder))
    database = database or _find_database(folder, all_files)
    files = _uploaded_files(folder, all_files, uploads)
    rows = read_anyloc_rows(database)
    listed, missing = _match_rows_to_files(rows, files)
    listed_paths = {photo.path for photo in listed}
    unlisted = [
        AnylocPhoto(path, utf8_path(Path(path.name)))
        for path in sorted(set().union(*files.values()) - listed_paths)
        if path.suffix.lower() in PHOTO_SUFFIXES
    ]
    unique, duplicates = _drop_duplicates(listed + unlisted)
    return AnylocFolder(
        database=database,
        rows=len(rows),
        photos=[photo.to_local_photo() for photo in unique],
        unlisted=len(unlisted),
        missing=missing,
        duplicates=duplicates,
        vocabularies=sorted(path for path in all_files if path.name == VOCABULARY_FILE),
    )


def _list_files(folder: Path) -> Iterator[Path]:
    """Every file below the folder, except hidden ones (`.git`, `.venv`, `.gitkeep`)."""
    for directory, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        yield from (Path(directory, name) for name in names if not name.startswith("."))


def _find_database(folder: Path, all_files: list[Path]) -> Path:
    found = sorted(path for path in all_files if path.name == DATABASE_NAME)
    if not found:
        raise InvalidRequest(
            "no_anyloc_database",
            f"No {DATABASE_NAME} found below {folder}. Specify it with --database FILE, or use "
            "placewise index DIR to import photos without a database.",
        )
    if len(found) > 1:
        raise InvalidRequest(
            "several_anyloc_databases",
            f"Several databases found: {', '.join(map(str, found))}. Specify one with "
            "--database FILE.",
        )
    return found[0]


def _uploaded_files(
    folder: Path, all_files: list[Path], uploads: Path | None
) -> dict[str, set[Path]]:
    """The files in folders named `uploads`, by file name."""
    if uploads is not None:
        paths = list(_list_files(uploads))
    elif folder.resolve().name == UPLOADS_FOLDER:
        paths = all_files
    else:
        paths = [
            path for path in all_files if UPLOADS_FOLDER in path.relative_to(folder).parts[:-1]
        ]
    if not paths:
        raise InvalidRequest(
            "no_anyloc_uploads",
            f"No photos found in a folder named {UPLOADS_FOLDER} below {folder}. Specify their "
            "folder with --uploads FOLDER.",
        )
    files: dict[str, set[Path]] = defaultdict(set)
    for path in paths:
        files[path.name].add(path)
    return files


def _match_rows_to_files(
    rows: list[AnylocRow], files: dict[str, set[Path]]
) -> tuple[list[AnylocPhoto], list[Json]]:
    listed: list[AnylocPhoto] = []
    missing: list[Json] = []
    for row in rows:
        path = PureWindowsPath(row.image_path)  # accepts / and \ as separators
        # Of several files with this name, take the one that shares most parent folders.
        candidates = sorted(
            files.get(path.name, ()), key=lambda file: (-_common_suffix_length(file, path), file)
        )
        if candidates:
            listed.append(AnylocPhoto(candidates[0], row.name or path.name, row.tags, row.metadata))
        else:
            missing.append(
                {
                    "path": row.image_path,
                    "filename": row.name,
                    "reason": "the database has a row for this file, but the file was not found",
                }
            )
    return listed, missing


def _common_suffix_length(file: Path, path: PureWindowsPath) -> int:
    """Number of path parts that are equal, counted from the end."""
    pairs = zip(reversed(file.parts), reversed(path.parts), strict=False)
    return len(list(takewhile(lambda pair: pair[0] == pair[1], pairs)))


def _drop_duplicates(photos: list[AnylocPhoto]) -> tuple[list[AnylocPhoto], list[Json]]:
    """Keep one photo per content; it takes over the tags and metadata of its duplicates."""
    first: dict[object, AnylocPhoto] = {}
    duplicates: list[Json] = []
    for key, photo in zip(_content_keys(photos), photos, strict=True):
        original = first.setdefault(key, photo)
        if original is photo:
            continue
        original.tags = list(dict.fromkeys(original.tags + photo.tags))
        duplicate = {"filename": photo.name, **photo.metadata}
        original.metadata.setdefault("anyloc_same_photo", []).append(duplicate)
        duplicates.append(
            {
                "path": utf8_path(photo.path),
                "filename": photo.name,
                "reason": f"the same photo as {original.name}",
            }
        )
    return list(first.values()), duplicates


def _content_keys(photos: list[AnylocPhoto]) -> Iterator[object]:
    """A key per photo that is equal for photos with equal bytes.

    Only files of equal size are hashed. An unreadable file gets a key of its own; its upload fails
    with the reason.
    """
    sizes: dict[int, set[Path]] = defaultdict(set)
    for photo in photos:
        sizes[_file_size(photo.path)].add(photo.path)
    for photo in photos:
        size = _file_size(photo.path)
        try:
            yield photo.path if len(sizes[size]) == 1 else _file_sha256(photo.path)
        except OSError:
            yield photo.path


def _file_size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return -1


def _file_sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
