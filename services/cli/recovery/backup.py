"""Backups of a running Placewise: a consistent copy of its object store in a folder.

```
backup.json            the manifest, which names the list of objects; written last
objects-<time>.jsonl   key, size, SHA-256 and time of each object of the backup, one per line
copied.jsonl           the same of the objects that an unfinished backup has copied
objects/<key>          the objects
```

**Consistency.** Objects are written once, before the rows that reference them. A backup copies all
objects (the long part). Then, in one snapshot of the database, it copies the journal up to there,
and adds a snapshot of what the journal lacks (`shared.journal`). Then it copies the objects that
were written meanwhile (the short part). What was deleted since the snapshot may be missing: chunks
were merged into later ones, and photos without their originals are not restored.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any
from uuid import UUID

from filelock import FileLock, Timeout
from sqlalchemy import select
from sqlalchemy.orm import Session

from services.cli.recovery.journal_rows import Progress
from shared.catalog.database.base import count_rows, db_now
from shared.catalog.database.session import NO_TIMEOUTS, Catalog
from shared.catalog.installation import Installation
from shared.catalog.photos import Photo, is_kept
from shared.config.private_files import FILE_MODE, make_private_folder, write_private
from shared.errors import Conflict, Misconfigured, NotFound, Unavailable
from shared.integrity.referenced_objects import list_referenced_objects
from shared.journal.outbox import snapshot_lines
from shared.journal.segments import put_lines
from shared.storage import FolderStore, ObjectStore
from shared.storage.copying import copy_object, hash_object
from shared.storage.keys import (
    IMPORTS,
    JOURNAL,
    ORIGINALS,
    OWNER_MARK,
    PREVIEWS,
    QUERIES,
    TRASH,
    is_original_key,
)
from shared.storage.protocol import ObjectInfo
from shared.storage.segments import SNAPSHOT_ENDING, list_segments, segment_key

BACKUP_FORMAT = 2
MAX_SNAPSHOTS = 5  # of the catalog, when the journal is merged meanwhile
LOCK_FILE = ".backup.lock"
COPIED = "copied.jsonl"

# Not backed up: notes of the store, objects that can be recomputed, temporary objects of requests
# and jobs, and orphans.
EXCLUDED_PREFIXES = (OWNER_MARK, IMPORTS, QUERIES, PREVIEWS, TRASH)


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
    release: str
    made_at: str
    """Time of the catalog's snapshot by its own clock: ISO 8601, UTC."""
    index: str
    """Name of the list of objects."""
    photos: int
    """Those in the trash included."""
    objects: int
    object_bytes: int
    missing: list[str] = field(default_factory=list)
    """Referenced objects that the store did not have."""
    damaged: list[str] = field(default_factory=list)
    """Objects whose hash differs from the catalog's."""
    format: int = BACKUP_FORMAT


class BackupFolder:
    """A backup in a folder."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def objects(self) -> FolderStore:
        """The store of the objects; the folder may be read-only."""
        return FolderStore(self.path / "objects", exclusive=False)

    def read_manifest(self) -> BackupManifest | None:
        """Return the manifest; None for a folder without a finished backup.

        Raises:
            Misconfigured: `backup_unreadable`, `backup_of_another_release`.
        """
        try:
            manifest: dict[str, Any] = json.loads((self.path / "backup.json").read_text())
        except FileNotFoundError:
            return None
        except ValueError as error:
            raise Misconfigured(
                "backup_unreadable",
                f"{self.path / 'backup.json'} can't be read. Use another backup.",
            ) from error
        if manifest.get("format") != BACKUP_FORMAT:
            raise Misconfigured(
                "backup_of_another_release",
                f"{self.path} has the format {manifest.get('format')!r}, but this release reads "
                f"{BACKUP_FORMAT}. Use the release that created it: {manifest.get('release')}.",
            )
        return BackupManifest(**manifest)

    def read_index(self, name: str) -> dict[str, BackedUpObject]:
        """Return the objects of a list by key.

        The last line of a key counts; a truncated one is ignored.
        """
        index = {}
        with contextlib.suppress(FileNotFoundError):
            for line in (self.path / name).read_text().splitlines():
                with contextlib.suppress(ValueError, TypeError):
                    entry = BackedUpObject(**json.loads(line))
                    index[entry.key] = entry
        return index

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Lock the folder for this process; Conflict (`backup_in_use`) while another has it."""
        lock = FileLock(self.path / LOCK_FILE, timeout=0, mode=FILE_MODE)
        try:
            with lock:
                yield
        except Timeout:
            raise Conflict(
                "backup_in_use",
                f"Another command is using {self.path}. Wait until it has finished.",
            ) from None


def create_backup(
    catalog: Catalog,
    store: ObjectStore,
    installation_id: UUID,
    path: Path,
    progress: Progress = lambda what, done, total: None,
) -> BackupManifest:
    """Create or update the backup in the folder `path`.

    Objects of an earlier or interrupted backup in the folder are not copied again. The earlier
    backup stays complete until the new one is finished.

    Args:
        progress: called after each object.

    Raises:
        Misconfigured: `not_a_backup` for a folder with other files; `other_installation` for the
            backup of another Placewise.
        Conflict: `backup_in_use`.
        Unavailable: the catalog or the store is unavailable; `backup_overtaken` when the journal is
            merged faster than it is copied.
    """
    make_private_folder(path)
    present = {entry.name for entry in path.iterdir()} - {LOCK_FILE}
    if present and not present & {COPIED, "backup.json"}:
        raise Misconfigured(
            "not_a_backup",
            f"{path} contains files that are not a backup. Use an empty folder, or one "
            "with a backup.",
        )
    folder = BackupFolder(path)
    with folder.lock():
        previous = folder.read_manifest()
        if previous is not None and previous.installation_id != str(installation_id):
            raise Misconfigured(
                "other_installation",
                f"{path} has a backup of another Placewise. Use a separate folder for each.",
            )
        return _Backup(catalog, store, folder, previous, progress).run(installation_id)


class _Backup:
    """One run of `create_backup`; `index` has the objects that are complete in the folder."""

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        folder: BackupFolder,
        previous: BackupManifest | None,
        progress: Progress,
    ) -> None:
        self._catalog = catalog.with_timeouts(NO_TIMEOUTS)
        self._store = store
        self._path, self._objects = folder.path, folder.objects
        self._progress = progress
        finished = folder.read_index(previous.index) if previous else {}
        self.index = finished | folder.read_index(COPIED)
        self._log = folder.path / COPIED
        self._log.touch(FILE_MODE)

    def run(self, installation_id: UUID) -> BackupManifest:
        self._copy_all("objects")
        for _ in range(MAX_SNAPSHOTS):
            with self._catalog.read() as session:
                # The first statement starts the snapshot of the database.
                made_at = session.execute(select(db_now())).scalar_one()
                journal = self._copy_journal(session)
                photos = count_rows(session, select(Photo.id).where(is_kept()))
                expected = {r.key: r.sha256 for r in list_referenced_objects(session)}
            if journal:
                break
        else:
            raise Unavailable(
                "backup_overtaken",
                "The journal's segments are merged faster than they can be copied. Run the backup "
                "again: it keeps the copied objects and has less to copy.",
            )
        listed = self._copy_all("new objects")
        missing = expected.keys() - self.index.keys()
        if missing:  # unless they were deleted since
            with self._catalog.read() as session:
                missing &= {referenced.key for referenced in list_referenced_objects(session)}
        keep = (listed | expected.keys() | journal) & self.index.keys()
        manifest = BackupManifest(
            installation_id=str(installation_id),
            release=version("placewise"),
            made_at=made_at.isoformat(),
            index=f"objects-{made_at:%Y%m%dT%H%M%S%f}.jsonl",
            photos=photos,
            objects=len(keep),
            object_bytes=sum(self.index[key].size_bytes for key in keep),
            missing=sorted(missing),
            damaged=sorted(
                key
                for key in expected.keys() & self.index.keys()
                if expected[key] not in (None, self.index[key].sha256)
            ),
        )
        self._finish(manifest, keep)
        return manifest

    def _copy_all(self, stage: str) -> set[str]:
        """Copy every object that is new or has changed; return the keys of all but the journal."""
        objects = [
            info
            for info in list_backup_objects(self._store)
            if not info.key.endswith(SNAPSHOT_ENDING)  # the backup has its own
        ]
        for done, info in enumerate(objects, start=1):
            with contextlib.suppress(NotFound):  # deleted since it was listed
                self._copy(info)
            self._progress(stage, done, len(objects))
        return {info.key for info in objects if not info.key.startswith(JOURNAL)}

    def _copy_journal(self, session: Session) -> set[str]:
        """Copy the journal up to the session's snapshot, and write what it lacks; return the keys.

        Returns an empty set if segments were merged with later ones.
        """
        sequence = session.scalar(select(Installation.journal_sequence)) or 0
        segments = [
            segment
            for segment in list_segments(self._store)
            if segment.first <= sequence and not segment.is_snapshot
        ]
        if any(segment.last > sequence for segment in segments):
            return set()
        try:
            for segment in segments:
                self._copy(ObjectInfo(segment.key, segment.size_bytes, segment.modified_at))
        except NotFound:
            return set()
        key = segment_key(sequence + 1, sequence + 1, snapshot=True)
        put_lines(self._objects, key, snapshot_lines(session))
        written = self._objects.head(key)
        assert written is not None
        self._add(written, *hash_object(self._objects, key))
        return {key, *(segment.key for segment in segments)}

    def _copy(self, info: ObjectInfo) -> None:
        """Copy an object unless the backup has it; NotFound when it no longer exists."""
        entry = self.index.get(info.key)
        if (
            entry is None
            or (entry.size_bytes, entry.modified) != (info.size_bytes, info.modified_at.isoformat())
            or not self._objects.path(info.key).is_file()
        ):
            self._add(info, *copy_object(self._store, self._objects, info.key))

    def _add(self, info: ObjectInfo, size_bytes: int, sha256: str) -> None:
        entry = BackedUpObject(info.key, size_bytes, sha256, info.modified_at.isoformat())
        self.index[info.key] = entry
        with self._log.open("a") as lines:
            # The line feed comes first and ends a line that a killed process left truncated.
            lines.write("\n" + json.dumps(asdict(entry)))

    def _finish(self, manifest: BackupManifest, keep: set[str]) -> None:
        """Write the list of the objects in `keep`, then the manifest, which makes it the backup.

        Then delete what only the previous backup had, and what an interrupted call left.
        """
        lines = (json.dumps(asdict(self.index[key])) + "\n" for key in sorted(keep))
        write_private(self._path / manifest.index, "".join(lines))
        write_private(self._path / "backup.json", json.dumps(asdict(manifest), indent=2) + "\n")
        write_private(self._log, "")
        for key in [info.key for info in self._objects.list("") if info.key not in keep]:
            self._objects.delete(key)
        for old in self._path.glob("objects-*.jsonl"):
            if old.name != manifest.index:
                old.unlink()


def list_backup_objects(store: ObjectStore) -> Iterator[ObjectInfo]:
    """Iterate over the objects to back up, referenced by rows or not (thumbnails, sign codes).

    Objects under `imports/` and files that people put into UPLOAD_DIR are the operator's.
    """
    for info in store.list(""):
        is_foreign = info.key.startswith(ORIGINALS) and not is_original_key(info.key)
        if not is_foreign and not info.key.startswith(EXCLUDED_PREFIXES):
            yield info
