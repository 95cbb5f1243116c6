"""The folder of a backup.

```
backup.json        what it is, of when, and which of the catalog-* folders counts: written last
catalog-<time>/    <table>.jsonl.gz, a row a line
objects/<key>      the objects
objects.jsonl      key, size, SHA-256 and time of each of them, a line each
```
"""

from __future__ import annotations

import contextlib
import functools
import json
import shutil
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from shared.errors import Conflict, Misconfigured
from shared.objects.folder import FolderStore
from shared.private_files import FILE_MODE, make_private_folder, write_private

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
        return FolderStore(self.path / "objects", alone=False)

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
