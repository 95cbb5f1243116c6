"""The folder of a backup: its files, its objects and the dump of the catalog's rows.

```
backup.json        the manifest, which names the valid catalog-* folder; written last
catalog-<time>/    <table>.jsonl.gz, one row per line
objects/<key>      the objects
objects.jsonl      key, size, SHA-256 and time of each object, one per line
```
"""

from __future__ import annotations

import contextlib
import functools
import gzip
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from sqlalchemy import Table, func, insert, select
from sqlalchemy.orm import Session

import shared.catalog.tables  # noqa: F401  (registers every table)
from shared.catalog.database.base import Base, from_json, to_json
from shared.catalog.installation import Installation
from shared.catalog.photos import PresignedUpload
from shared.catalog.processes import RegisteredProcess, RegisteredSearchWorker
from shared.config.private_files import FILE_MODE, FOLDER_MODE, make_private_folder, write_private
from shared.errors import Conflict, Misconfigured
from shared.storage import ObjectStore
from shared.storage.copying import copy_object
from shared.storage.folder import FolderStore
from shared.storage.keys import (
    FEATURES,
    IMPORTS,
    INCOMING,
    ORIGINALS,
    OWNER_MARK,
    PREVIEWS,
    QUERIES,
    TRASH,
    is_original_key,
)
from shared.storage.protocol import ObjectInfo

BACKUP_FORMAT = 1
LOCK_FILE = ".backup.lock"


@dataclass(frozen=True, slots=True)
class BackedUpObject:
    """An object in the backup. `modified` is the modification time of the original, ISO 8601."""

    key: str
    size_bytes: int
    sha256: str
    modified: str


@dataclass(frozen=True, slots=True)
class BackupManifest:
    """Content of `backup.json`."""

    installation_id: str
    schema: str
    """The revision of the catalog's schema."""
    release: str
    made_at: str
    """Time of the catalog's snapshot by its own clock: ISO 8601, UTC."""
    catalog: str
    """Name of the folder with the catalog's rows."""
    rows: dict[str, int]
    """Number of rows by table."""
    objects: int
    object_bytes: int
    missing: list[str] = field(default_factory=list)
    """Referenced objects that the store did not have."""
    damaged: list[str] = field(default_factory=list)
    """Objects whose hash differs from the catalog's."""
    journal_sequence: int = 0
    """Sequence number of the last journal segment that the catalog had written."""
    format: int = BACKUP_FORMAT


class BackupFolder:
    """A backup in a folder. `index` has its objects by key, once the folder was opened."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.index: dict[str, BackedUpObject] = {}
        self._index_file = path / "objects.jsonl"

    @functools.cached_property
    def objects(self) -> FolderStore:
        """The store of the objects; the folder may be read-only."""
        return FolderStore(self.path / "objects", exclusive=False)

    def about(self) -> BackupManifest | None:
        """Return the manifest; None for a folder without a finished backup."""
        try:
            manifest: dict[str, Any] = json.loads((self.path / "backup.json").read_text())
        except FileNotFoundError:
            return None
        except ValueError as error:
            raise _unreadable(self.path, "backup.json") from error
        if manifest.get("format") != BACKUP_FORMAT:
            raise Misconfigured(
                "backup_of_another_release",
                f"{self.path} has the format {manifest.get('format')!r}, but this release reads "
                f"{BACKUP_FORMAT}. Use the release that created it: {manifest.get('release')}.",
            )
        return BackupManifest(**manifest)

    @contextlib.contextmanager
    def exclusive_lock(self) -> Iterator[None]:
        """Lock the folder for this process; Conflict (`backup_in_use`) while another has it."""
        lock = FileLock(self.path / LOCK_FILE, timeout=0, mode=FILE_MODE)
        try:
            lock.acquire()
        except Timeout:
            raise Conflict(
                "backup_in_use",
                f"Another command is using {self.path}. Wait until it has finished.",
            ) from None
        try:
            yield
        finally:
            lock.release()

    def open_for_writing(self) -> None:
        """Create the folder, or open an existing backup to continue it.

        Raises:
            Misconfigured: `not_a_backup` for a folder with other files.
        """
        make_private_folder(self.path)
        present = {entry.name for entry in self.path.iterdir()} - {LOCK_FILE}
        if present and not present & {"objects.jsonl", "backup.json"}:
            raise Misconfigured(
                "not_a_backup",
                f"{self.path} contains files that are not a backup. Use an empty folder, or one "
                "with a backup.",
            )
        self._index_file.touch(FILE_MODE)
        self.read_index()

    def read_index(self) -> None:
        """Read the index. The last line of a key counts; a truncated one is ignored."""
        self.index = {}
        with contextlib.suppress(FileNotFoundError):
            for line in self._index_file.read_text().splitlines():
                with contextlib.suppress(ValueError, TypeError):
                    entry = BackedUpObject(**json.loads(line))
                    self.index[entry.key] = entry

    def add_to_index(self, entry: BackedUpObject) -> None:
        """Record that the object is completely in the backup."""
        self.index[entry.key] = entry
        with self._index_file.open("a") as lines:
            # The line feed comes first and ends a line that a killed process left truncated.
            lines.write("\n" + json.dumps(asdict(entry)))

    def finish(self, about: BackupManifest, keep: set[str]) -> None:
        """Write the manifest and the index of the objects in `keep`.

        Then delete the other objects, also those that an interrupted call left, and the previous
        backup's rows: the backup can be restored at any moment.
        """
        write_private(self.path / "backup.json", json.dumps(asdict(about), indent=2) + "\n")
        self.index = {key: entry for key, entry in self.index.items() if key in keep}
        lines = (json.dumps(asdict(entry)) + "\n" for entry in self.index.values())
        write_private(self._index_file, "".join(lines))
        objects = self.objects
        for key in [info.key for info in objects.list("") if info.key not in self.index]:
            objects.delete(key)
        for old in self.path.glob("catalog-*"):
            if old.name != about.catalog:
                shutil.rmtree(old)


def open_backup(path: Path) -> tuple[BackupFolder, BackupManifest]:
    """Open a finished backup for reading.

    Raises:
        Misconfigured: `no_backup`, `backup_of_another_release`, `backup_unreadable`.
    """
    folder = BackupFolder(path)
    about = folder.about()
    if about is None:
        raise Misconfigured(
            "no_backup",
            f"{path} has no finished backup (no backup.json). If a backup was interrupted, run "
            "`placewise backup` on it again.",
        )
    folder.read_index()
    return folder, about


def _unreadable(path: Path, name: str) -> Misconfigured:
    return Misconfigured("backup_unreadable", f"{path / name} can't be read. Use another backup.")


# Not backed up: notes of the store, objects that can be recomputed, temporary objects of requests
# and jobs, and orphans.
EXCLUDED_PREFIXES = (OWNER_MARK, IMPORTS, INCOMING, QUERIES, FEATURES, PREVIEWS, TRASH)


def list_backup_objects(store: ObjectStore) -> Iterator[ObjectInfo]:
    """Iterate over the objects to back up, referenced by rows or not (thumbnails, codes).

    Objects under `imports/` and files that people put into UPLOAD_DIR are the operator's.
    """
    for info in store.list(""):
        is_foreign = info.key.startswith(ORIGINALS) and not is_original_key(info.key)
        if is_foreign or info.key.startswith(EXCLUDED_PREFIXES):
            continue
        yield info


def is_backed_up(folder: BackupFolder, info: ObjectInfo) -> bool:
    """Return whether the backup has the current version of the object."""
    entry = folder.index.get(info.key)
    return (
        entry is not None
        and entry.size_bytes == info.size_bytes
        and entry.modified == info.modified_at.isoformat()
        and folder.objects.path(info.key).is_file()
    )


def back_up_object(store: ObjectStore, folder: BackupFolder, info: ObjectInfo) -> int:
    """Copy the object into the backup; return its size. NotFound when it no longer exists."""
    size, sha256 = copy_object(store, folder.objects, info.key)
    folder.add_to_index(BackedUpObject(info.key, size, sha256, info.modified_at.isoformat()))
    return size


ROWS_PER_STATEMENT = 1000
GZIP_LEVEL = 1  # reduces rows to a fifth, and is faster than the disk

# Not backed up: running processes, presigned uploads that expire, the schema's compatibility.
EXCLUDED_TABLES = frozenset(
    table.__tablename__ for table in (RegisteredSearchWorker, RegisteredProcess, PresignedUpload)
)
# The target has its own row (`shared.backup.restore`).
NOT_RESTORED_TABLES = frozenset({Installation.__tablename__})

BackupProgress = Callable[[str, int, int], object]
"""Progress callback: what is done, number done, total."""


def backup_tables() -> list[Table]:
    """Return the tables of a backup, each after those that it references."""
    return [table for table in Base.metadata.sorted_tables if table.name not in EXCLUDED_TABLES]


def dump_rows(session: Session, folder: Path, progress: BackupProgress) -> dict[str, int]:
    """Write every row to `<table>.jsonl.gz`; return the number of rows by table."""
    folder.mkdir(FOLDER_MODE)
    counts: dict[str, int] = {}
    tables = backup_tables()
    total = sum(session.scalar(select(func.count()).select_from(table)) or 0 for table in tables)
    done = 0
    for table in tables:
        done_before = done
        rows = session.execute(select(table).execution_options(yield_per=ROWS_PER_STATEMENT))
        file = folder / f"{table.name}.jsonl.gz"
        file.touch(FILE_MODE)
        with gzip.open(file, "wt", compresslevel=GZIP_LEVEL) as lines:
            for row in rows.mappings():
                values = {name: to_json(value) for name, value in row.items()}
                lines.write(json.dumps(values, ensure_ascii=False) + "\n")
                done += 1
                if done % ROWS_PER_STATEMENT == 0:
                    progress("rows", done, total)
        counts[table.name] = done - done_before
    progress("rows", done, done)
    return counts


def load_rows(
    session: Session, folder: Path, counts: dict[str, int], progress: BackupProgress
) -> None:
    """Insert the rows that `dump_rows` has written.

    Raises:
        Misconfigured: `backup_damaged` when a table does not have `counts` rows, or is unreadable.
    """
    tables = [table for table in backup_tables() if table.name not in NOT_RESTORED_TABLES]
    total = sum(counts.get(table.name, 0) for table in tables)
    done_before = 0
    for table in tables:
        done = 0
        try:
            for rows in _read_batches(folder / f"{table.name}.jsonl.gz", table):
                session.execute(insert(table), rows)
                done += len(rows)
                progress("rows", done_before + done, total)
        except (OSError, EOFError, ValueError, KeyError) as error:
            raise _damaged_error(table, str(error)) from error
        if done != counts.get(table.name):
            raise _damaged_error(table, f"{done} rows of {counts.get(table.name)}")
        done_before += done


def _read_batches(file: Path, table: Table) -> Iterator[list[dict[str, Any]]]:
    batch: list[dict[str, Any]] = []
    with gzip.open(file, "rt") as lines:
        for line in lines:
            values = json.loads(line)
            batch.append({c.name: from_json(c, values[c.name]) for c in table.columns})
            if len(batch) == ROWS_PER_STATEMENT:
                yield batch
                batch = []
    if batch:
        yield batch


def _damaged_error(table: Table, reason: str) -> Misconfigured:
    return Misconfigured(
        "backup_damaged",
        f"The rows of {table.name} in the backup are damaged ({reason}). Use another backup.",
    )
