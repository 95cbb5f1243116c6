"""The predecessor's folder: its rows and its photos brought together.

A row's `image_path` is one of another machine or container, and the file's name is not the row's
id: what joins them is the path's last part, below a folder called `uploads`.

Reading the predecessor's catalog: `similarity.db` of the AnyLoc similarity service.

Its table `images` has a row per photo: `image_id`, `image_path` (of the machine that it ran on),
`original_filename`, `upload_time` (SQLite's CURRENT_TIMESTAMP: UTC without saying so),
`metadata_json`, `tags`; the other columns are about its own feature files.
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
from services.cli.output import printable_path
from shared.client import Json
from shared.errors import InvalidRequest, PlacewiseError
from shared.imaging.file_formats import PHOTO_SUFFIXES

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


UPLOADS_FOLDER = "uploads"
VOCABULARY_FILE = "c_centers.pt"


@dataclass(slots=True)
class AnylocPhoto:
    path: Path
    name: str
    tags: list[str] = field(default_factory=list)
    metadata: dict[str, Any] = field(default_factory=dict)

    def to_local_photo(self) -> LocalPhoto:
        """As the upload form says it."""
        fields = {"tags": ",".join(self.tags), "metadata": json.dumps(self.metadata)}
        return LocalPhoto(
            self.path, {k: v for k, v in fields.items() if v not in ("", "{}")}, self.name
        )


@dataclass(slots=True)
class AnylocFolder:
    """What there is to import, and what is not imported."""

    database: Path
    rows: int
    photos: list[LocalPhoto]
    unlisted: int
    """How many of the photos no row names."""
    missing: list[Json]
    """Rows without a file."""
    duplicates: list[Json]
    """Photos whose bytes are those of another one, which is imported."""
    vocabularies: list[Path]


def read_anyloc_folder(folder: Path, database: Path | None, uploads: Path | None) -> AnylocFolder:
    """Look through the folder; `database` and `uploads` say where those lie if not below it.

    Raises InvalidRequest: `no_anyloc_database`, `several_anyloc_databases`, `no_anyloc_uploads`,
    `bad_anyloc_database`.
    """
    below = list(_list_files(folder))
    database = database or _find_database(folder, below)
    files = _uploaded_files(folder, below, uploads)
    rows = read_anyloc_rows(database)
    listed, missing = _match_rows_to_files(rows, files)
    named = {photo.path for photo in listed}
    unlisted = [
        AnylocPhoto(path, printable_path(Path(path.name)))
        for path in sorted(set().union(*files.values()) - named)
        if path.suffix.lower() in PHOTO_SUFFIXES
    ]
    kept, duplicates = _drop_duplicates(listed + unlisted)
    return AnylocFolder(
        database=database,
        rows=len(rows),
        photos=[photo.to_local_photo() for photo in kept],
        unlisted=len(unlisted),
        missing=missing,
        duplicates=duplicates,
        vocabularies=sorted(path for path in below if path.name == VOCABULARY_FILE),
    )


def _list_files(folder: Path) -> Iterator[Path]:
    """Every file below the folder, but for hidden ones (`.git`, `.venv`, `.gitkeep`)."""
    for directory, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        yield from (Path(directory, name) for name in names if not name.startswith("."))


def _find_database(folder: Path, below: list[Path]) -> Path:
    found = sorted(path for path in below if path.name == DATABASE_NAME)
    if not found:
        raise InvalidRequest(
            "no_anyloc_database",
            f"There is no {DATABASE_NAME} below {folder}. Name it: --database FILE; or, for photos "
            "without a database: placewise index DIR.",
        )
    if len(found) > 1:
        raise InvalidRequest(
            "several_anyloc_databases",
            f"There are several databases: {', '.join(map(str, found))}. Say which one is meant: "
            "--database FILE.",
        )
    return found[0]


def _uploaded_files(folder: Path, below: list[Path], uploads: Path | None) -> dict[str, set[Path]]:
    """The files below the folders called `uploads`, by name."""
    if uploads is not None:
        paths = list(_list_files(uploads))
    elif folder.resolve().name == UPLOADS_FOLDER:
        paths = below
    else:
        paths = [path for path in below if UPLOADS_FOLDER in path.relative_to(folder).parts[:-1]]
    if not paths:
        raise InvalidRequest(
            "no_anyloc_uploads",
            f"No photo lies in a folder called {UPLOADS_FOLDER} below {folder}. If they lie "
            "elsewhere: "
            "--uploads FOLDER.",
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
        path = PureWindowsPath(row.image_path)  # takes both kinds of slashes
        # Of several with this name, one whose folders are called most like the row's.
        there = sorted(
            files.get(path.name, ()), key=lambda file: (-_common_suffix_length(file, path), file)
        )
        if there:
            listed.append(AnylocPhoto(there[0], row.name or path.name, row.tags, row.metadata))
        else:
            missing.append(
                {
                    "path": row.image_path,
                    "filename": row.name,
                    "reason": "the file is not there; its row says only what it was called",
                }
            )
    return listed, missing


def _common_suffix_length(file: Path, path: PureWindowsPath) -> int:
    """How many parts the two paths have in common, from the end."""
    pairs = zip(reversed(file.parts), reversed(path.parts), strict=False)
    return len(list(takewhile(lambda pair: pair[0] == pair[1], pairs)))


def _drop_duplicates(photos: list[AnylocPhoto]) -> tuple[list[AnylocPhoto], list[Json]]:
    """A map keeps the same bytes once: the first one stays and remembers the others."""
    first: dict[object, AnylocPhoto] = {}
    duplicates: list[Json] = []
    for key, photo in zip(_content_keys(photos), photos, strict=True):
        kept = first.setdefault(key, photo)
        if kept is photo:
            continue
        kept.tags = list(dict.fromkeys(kept.tags + photo.tags))
        other = {"filename": photo.name, **photo.metadata}
        kept.metadata.setdefault("anyloc_same_photo", []).append(other)
        duplicates.append(
            {
                "path": printable_path(photo.path),
                "filename": photo.name,
                "reason": f"the same photo as {kept.name}",
            }
        )
    return list(first.values()), duplicates


def _content_keys(photos: list[AnylocPhoto]) -> Iterator[object]:
    """For each photo a value that it shares with those of the same bytes.

    Only files of the same size are read. One that can't be read shares its value with none: the
    upload says why it is refused.
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
