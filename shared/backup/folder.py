"""The folder of a backup.

```
backup.json        what it is, of when, and which of the catalog-* folders counts: written last
catalog-<time>/    <table>.jsonl.gz, a row a line
objects/<key>      the objects
objects.jsonl      key, size, SHA-256 and time of each of them, a line each
```

Copying one object from store to store, hashed on the way.

The catalog's rows as JSON lines, the same from SQLite and PostgreSQL.
"""

from __future__ import annotations

import contextlib
import functools
import gzip
import hashlib
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from sqlalchemy import Table, func, insert, select
from sqlalchemy.orm import Session

import shared.catalog.tables  # noqa: F401  (every table has to be known)
from shared.catalog.base import Base, from_json, to_json
from shared.catalog.installation import Installation
from shared.catalog.photos import PresignedUpload
from shared.catalog.processes import RegisteredProcess, RegisteredSearchWorker
from shared.catalog.tables import SchemaCompatibility
from shared.config.private_files import FILE_MODE, FOLDER_MODE, make_private_folder, write_private
from shared.errors import Conflict, Misconfigured
from shared.storage import ObjectStore
from shared.storage.folder import OWNER_MARK, FolderStore
from shared.storage.keys import FEATURES, INCOMING, ORIGINALS, QUERIES, TRASH, WORK, is_original_key
from shared.storage.protocol import ObjectInfo

BACKUP_FORMAT = 1
LOCK_FILE = ".backup.lock"


@dataclass(frozen=True, slots=True)
class BackedUpObject:
    """An object in the backup. `modified` is when the original was written, ISO 8601."""

    key: str
    size_bytes: int
    sha256: str
    modified: str


@dataclass(frozen=True, slots=True)
class BackupManifest:
    """What `backup.json` says."""

    installation_id: str
    schema: str
    """The revision of the catalog's schema."""
    release: str
    made_at: str
    """When the catalog was read, by its own clock: ISO 8601, UTC."""
    catalog: str
    """The folder of its rows."""
    rows: dict[str, int]
    """By table."""
    objects: int
    object_bytes: int
    missing: list[str] = field(default_factory=list)
    """Objects that the catalog names and the store did not have."""
    damaged: list[str] = field(default_factory=list)
    """Objects whose bytes are not those that the catalog knows."""
    journal_sequence: int = 0
    """Of the last journal segment that the catalog had written."""
    format: int = BACKUP_FORMAT


class BackupFolder:
    """One backup. `index` says which objects are there; it is read when the folder is opened."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.index: dict[str, BackedUpObject] = {}
        self._index_file = path / "objects.jsonl"

    @functools.cached_property
    def objects(self) -> FolderStore:
        """May lie on a medium that can only be read."""
        return FolderStore(self.path / "objects", exclusive=False)

    def about(self) -> BackupManifest | None:
        """None for a folder in which no backup was ever finished."""
        try:
            said: dict[str, Any] = json.loads((self.path / "backup.json").read_text())
        except FileNotFoundError:
            return None
        except ValueError as error:
            raise _unreadable(self.path, "backup.json") from error
        if said.get("format") != BACKUP_FORMAT:
            raise Misconfigured(
                "backup_of_another_release",
                f"{self.path} has the format {said.get('format')!r}, and this release reads "
                f"{BACKUP_FORMAT}. Use the release that made it: {said.get('release')}.",
            )
        return BackupManifest(**said)

    @contextlib.contextmanager
    def exclusive_lock(self) -> Iterator[None]:
        """For this process alone; Conflict (`backup_in_use`) while another one has it."""
        lock = FileLock(self.path / LOCK_FILE, timeout=0, mode=FILE_MODE)
        try:
            lock.acquire()
        except Timeout:
            raise Conflict(
                "backup_in_use", f"Another command works on {self.path}. Wait for its end."
            ) from None
        try:
            yield
        finally:
            lock.release()

    def open_for_writing(self) -> None:
        """Make the folder, or go on with what is there. Misconfigured (`not_a_backup`) for one that
        holds something else."""
        make_private_folder(self.path)
        there = {entry.name for entry in self.path.iterdir()} - {LOCK_FILE}
        if there and not there & {"objects.jsonl", "backup.json"}:
            raise Misconfigured(
                "not_a_backup",
                f"{self.path} holds something that is no backup. Give an empty folder, or one "
                "that a backup was begun in.",
            )
        self._index_file.touch(FILE_MODE)
        self.read_index()

    def read_index(self) -> None:
        """Later lines count; a last one that was cut off by a kill does not."""
        self.index = {}
        with contextlib.suppress(FileNotFoundError):
            for line in self._index_file.read_text().splitlines():
                with contextlib.suppress(ValueError, TypeError):
                    kept = BackedUpObject(**json.loads(line))
                    self.index[kept.key] = kept

    def note(self, kept: BackedUpObject) -> None:
        """The object is there, whole."""
        self.index[kept.key] = kept
        with self._index_file.open("a") as lines:
            # Begins a line: what a kill has cut off before ends here.
            lines.write("\n" + json.dumps(asdict(kept)))

    def finish(self, about: BackupManifest, keep: set[str]) -> None:
        """From here on the folder is this backup. Objects that are not in `keep`, and the rows of
        the backup before, go."""
        write_private(self.path / "backup.json", json.dumps(asdict(about), indent=2) + "\n")
        objects = self.objects
        for key in self.index.keys() - keep:
            objects.delete(key)
            del self.index[key]
        lines = (json.dumps(asdict(kept)) + "\n" for kept in self.index.values())
        write_private(self._index_file, "".join(lines))
        for old in self.path.glob("catalog-*"):
            if old.name != about.catalog:
                shutil.rmtree(old)


def open_backup(path: Path) -> tuple[BackupFolder, BackupManifest]:
    """A finished backup, to be read. Misconfigured: `no_backup`, `backup_of_another_release`,
    `backup_unreadable`."""
    folder = BackupFolder(path)
    about = folder.about()
    if about is None:
        raise Misconfigured(
            "no_backup",
            f"{path} holds no finished backup (it has no backup.json). If one was interrupted, run "
            "`placewise backup` on it again.",
        )
    folder.read_index()
    return folder, about


def _unreadable(path: Path, name: str) -> Misconfigured:
    return Misconfigured("backup_unreadable", f"{path / name} can't be read. Take another backup.")


COPY_BLOCK_BYTES = 1024 * 1024
# Notes of the store itself; made again when they are wanted; of calls that have ended by the time
# of a restore; orphans.
EXCLUDED_PREFIXES = (OWNER_MARK, INCOMING, QUERIES, FEATURES, TRASH, WORK)


def list_backup_objects(store: ObjectStore, import_prefix: str) -> Iterator[ObjectInfo]:
    """What belongs into a backup of the store, whether rows name it or not (thumbnails, codes).
    What lies under `import_prefix`, or was put into UPLOAD_DIR by hand, is its owner's."""
    for info in store.list(""):
        others = info.key.startswith(ORIGINALS) and not is_original_key(info.key)
        if others or info.key.startswith((*EXCLUDED_PREFIXES, import_prefix)):
            continue
        yield info


def is_backed_up(folder: BackupFolder, info: ObjectInfo) -> bool:
    """Whether the backup has the object as it is now."""
    kept = folder.index.get(info.key)
    return (
        kept is not None
        and kept.size_bytes == info.size_bytes
        and kept.modified == info.modified_at.isoformat()
        and folder.objects.path(info.key).is_file()
    )


def back_up_object(store: ObjectStore, folder: BackupFolder, info: ObjectInfo) -> int:
    """Copy the object into the backup; its bytes. NotFound when it is gone."""
    size, sha256 = copy_object(store, folder.objects, info.key)
    folder.note(BackedUpObject(info.key, size, sha256, info.modified_at.isoformat()))
    return size


def copy_object(source: ObjectStore, target: ObjectStore, key: str) -> tuple[int, str]:
    """Copy the object; its size in bytes and its SHA-256. NotFound where there is none."""
    digest, size = hashlib.sha256(), 0
    with source.open(key) as file:
        writer = target.writer(key)
        try:
            while piece := file.read(COPY_BLOCK_BYTES):
                digest.update(piece)
                writer.write(piece)
                size += len(piece)
            writer.commit()
        finally:
            writer.abort()
    return size, digest.hexdigest()


def hash_object(store: ObjectStore, key: str) -> tuple[int, str]:
    """The object's size in bytes and its SHA-256. NotFound where there is none."""
    digest, size = hashlib.sha256(), 0
    with store.open(key) as file:
        while piece := file.read(COPY_BLOCK_BYTES):
            digest.update(piece)
            size += len(piece)
    return size, digest.hexdigest()


ROWS_PER_STATEMENT = 1000
GZIP_LEVEL = 1  # of gzip: rows shrink to a fifth, and the disk stays the slower part

# What says nothing elsewhere or later: who is alive now, addresses that expire, the schema's own.
EXCLUDED_TABLES = frozenset(
    table.__tablename__
    for table in (RegisteredSearchWorker, RegisteredProcess, PresignedUpload, SchemaCompatibility)
)
# The target has its own: `shared.backup.restore`.
NOT_RESTORED_TABLES = frozenset({Installation.__tablename__})

BackupProgress = Callable[[str, int, int], object]
"""Told what is done, how much of it, and of how much."""


def backup_tables() -> list[Table]:
    """Those that a backup holds; each comes after those that its foreign keys lead to."""
    return [table for table in Base.metadata.sorted_tables if table.name not in EXCLUDED_TABLES]


def dump_rows(session: Session, folder: Path, progress: BackupProgress) -> dict[str, int]:
    """Every row into `<table>.jsonl.gz`; how many each table has."""
    folder.mkdir(FOLDER_MODE)
    counts = {}
    for table in backup_tables():
        total = session.scalar(select(func.count()).select_from(table)) or 0
        done = 0
        rows = session.execute(select(table).execution_options(yield_per=ROWS_PER_STATEMENT))
        file = folder / f"{table.name}.jsonl.gz"
        file.touch(FILE_MODE)
        with gzip.open(file, "wt", compresslevel=GZIP_LEVEL) as lines:
            for row in rows.mappings():
                values = {name: to_json(value) for name, value in row.items()}
                lines.write(json.dumps(values, ensure_ascii=False) + "\n")
                done += 1
                if done % ROWS_PER_STATEMENT == 0:
                    progress(f"rows of {table.name}", done, total)
        counts[table.name] = done
        progress(f"rows of {table.name}", done, done)
    return counts


def load_rows(
    session: Session, folder: Path, counts: dict[str, int], progress: BackupProgress
) -> None:
    """Insert what `dump_rows` has written. Misconfigured (`backup_damaged`) when a table has other
    than `counts` rows, or can't be read."""
    for table in backup_tables():
        if table.name in NOT_RESTORED_TABLES:
            continue
        done = 0
        try:
            for some in _read(folder / f"{table.name}.jsonl.gz", table):
                session.execute(insert(table), some)
                done += len(some)
                progress(f"rows of {table.name}", done, counts[table.name])
        except (OSError, EOFError, ValueError, KeyError) as error:
            raise _damaged_error(table, str(error)) from error
        if done != counts.get(table.name):
            raise _damaged_error(table, f"{done} rows of {counts.get(table.name)}")


def _read(file: Path, table: Table) -> Iterator[list[dict[str, Any]]]:
    some: list[dict[str, Any]] = []
    with gzip.open(file, "rt") as lines:
        for line in lines:
            values = json.loads(line)
            some.append({c.name: from_json(c, values[c.name]) for c in table.columns})
            if len(some) == ROWS_PER_STATEMENT:
                yield some
                some = []
    if some:
        yield some


def _damaged_error(table: Table, why: str) -> Misconfigured:
    return Misconfigured(
        "backup_damaged",
        f"The rows of {table.name} in the backup are not what was written ({why}). Take another "
        "backup.",
    )
