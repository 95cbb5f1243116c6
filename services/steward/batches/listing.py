"""From an archive to the items of a batch: its photos, with what its table says of them.

From a prefix of the object store to the items of a batch: every photo below it, by its key.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any

from services.steward.archives import Archive, ArchiveMember
from services.steward.archives.archive import MemberKind
from shared.datasets.utm_filenames import upload_fields_of_file_name
from shared.errors import InvalidRequest, PlacewiseError, TooLarge, Unprocessable, UnsupportedMedia
from shared.imaging.file_formats import PHOTO_SUFFIXES
from shared.ingest.photo_metadata import (
    MAX_MANIFEST_BYTES,
    MAX_REPORTED_LINES,
    ManifestEntry,
    bad_lines_error,
    read_csv_manifest,
    read_jsonl_manifest,
)
from shared.jobs import JobState
from shared.storage import ObjectStore

TABLE_NAME, MANIFEST_NAME = "photos.csv", "manifest.jsonl"
# Archives inside of archives.
ARCHIVE_SUFFIXES = {".zip", ".tar", ".tgz", ".gz", ".bz2", ".xz", ".zst", ".7z", ".rar"}
MAX_LABEL_CHARACTERS = 1000


@dataclass(slots=True)
class BatchListing:
    items: list[dict[str, Any]] = field(default_factory=list)
    """Columns of BatchItem."""
    ignored: int = 0
    """Members that are no photos and were not meant to be: folders, texts, what systems leave."""


def list_archive_photos(archive: Archive) -> BatchListing:
    """What of the archive is to be brought in.

    Raises what `Archive.members` does, and Unprocessable or InvalidRequest: `no_photos`,
    `bad_table`, `bad_manifest`, `several_manifests`.
    """
    listing = BatchListing()
    photos: list[tuple[str, ArchiveMember]] = []
    tables: list[tuple[str, ArchiveMember]] = []
    for member in archive.members():
        name = _display_name(member.name)
        path = PurePosixPath(name)
        if _is_system_file(path) or member.kind == MemberKind.FOLDER:
            listing.ignored += 1
        elif path.name in (TABLE_NAME, MANIFEST_NAME):
            tables.append((name, member))
        elif path.suffix.lower() in PHOTO_SUFFIXES | ARCHIVE_SUFFIXES:
            photos.append((name, member))
        else:
            listing.ignored += 1
    if not photos:
        raise Unprocessable(
            "no_photos", f"The archive has no photo ({', '.join(sorted(PHOTO_SUFFIXES))}) in it."
        )
    said = _read_table(archive, tables, {name for name, _ in photos})
    listing.items = list(_to_items(photos, said))
    return listing


def _display_name(name: str) -> str:
    """What the member is called: for people, and for its line in the table. No path to anything."""
    kept = "".join(c for c in name.replace("\\", "/") if c.isprintable())
    return kept.removeprefix("./")[:MAX_LABEL_CHARACTERS] or "photo"


def _is_system_file(path: PurePosixPath) -> bool:
    """What macOS and others leave behind: `__MACOSX/`, `._a.jpg`, `.DS_Store`, `.git/`."""
    return any(
        part == "__MACOSX" or (part.startswith(".") and part not in (".", ".."))
        for part in path.parts
    )


def _read_table(
    archive: Archive, tables: list[tuple[str, ArchiveMember]], names: set[str]
) -> dict[str, ManifestEntry]:
    """What the outermost table says, by the photos' names."""
    if not tables:
        return {}
    depth = min(name.count("/") for name, _ in tables)
    outermost = [(name, member) for name, member in tables if name.count("/") == depth]
    if len(outermost) > 1:
        raise InvalidRequest(
            "several_manifests",
            f"The archive has {' and '.join(name for name, _ in outermost[:5])}: leave one.",
        )
    [(called, member)] = outermost
    if member.size_bytes > MAX_MANIFEST_BYTES:
        raise TooLarge("manifest_too_large", f"{called} is larger than {MAX_MANIFEST_BYTES} bytes.")
    data = b"".join(archive.read(member))
    is_table = called.endswith(TABLE_NAME)
    lines = read_csv_manifest(data, called) if is_table else read_jsonl_manifest(data, called)
    # Names in it are relative to where it lies: people pack a folder as a whole.
    folder = called[: called.rfind("/") + 1]
    said = {folder + _display_name(line.name): line for line in lines}
    strange = [
        (line.line, f"the archive has no photo {name!r}")
        for name, line in said.items()
        if name not in names
    ]
    if strange:
        code = "bad_table" if is_table else "bad_manifest"
        raise bad_lines_error(code, called, strange[:MAX_REPORTED_LINES])
    return said


def _to_items(
    photos: list[tuple[str, ArchiveMember]], manifest_lines: dict[str, ManifestEntry]
) -> Iterator[dict[str, Any]]:
    times = Counter(name for name, _ in photos)
    for name, member in photos:
        line = manifest_lines.get(name)
        item: dict[str, Any] = {
            "name": name,
            "source": member_location(member),
            "line": line.line if line else None,
        }
        try:
            item["fields"] = _validate_member(name, member, line, times[name])
        except PlacewiseError as error:
            item |= {"state": JobState.FAILED, "error": error.as_problem()}
        yield item


def _validate_member(
    name: str, member: ArchiveMember, manifest_line: ManifestEntry | None, times: int
) -> dict[str, str]:
    """What is said of the photo; raises why it can't be brought in, as far as that can be told."""
    if member.fault is not None:
        raise member.fault
    path = PurePosixPath(name)
    if path.suffix.lower() in ARCHIVE_SUFFIXES:
        raise UnsupportedMedia(
            "nested_archive", "An archive inside of an archive is not unpacked: upload it itself."
        )
    if manifest_line is not None and times > 1:
        raise Unprocessable(
            "ambiguous_name",
            f"{times} photos of the archive are called {name!r}, and line "
            f"{manifest_line.line} of its table "
            "does not say which of them it means.",
        )
    return {
        **upload_fields_of_file_name(path.name, None),
        **(manifest_line.fields if manifest_line else {}),
    }


def member_location(member: ArchiveMember) -> dict[str, Any]:
    """What is kept of a member to find it again: `member_from_location` reads it."""
    return {
        "offset": member.offset,
        "size_bytes": member.size_bytes,
        "packed_bytes": member.packed_bytes,
        "method": member.method,
        "crc32": member.crc32,
    }


def member_from_location(name: str, place: dict[str, Any]) -> ArchiveMember:
    """The member that `place_of` has kept."""
    return ArchiveMember(name=name, kind=MemberKind.FILE, **place)


def list_prefix_photos(store: ObjectStore, prefix: str, max_photos: int) -> BatchListing:
    """The photos below the prefix in the order of their keys, with what their names say of them.

    Objects that have no photo's suffix, or a hidden name, are passed over and counted. Raises
    Unprocessable (`no_photos`), TooLarge (`too_many_photos_error`), Unavailable.
    """
    listing = BatchListing()
    keys: list[str] = []
    for info in store.list(prefix):
        path = PurePosixPath(info.key.removeprefix(prefix))
        hidden = any(part.startswith(".") for part in path.parts)
        if hidden or path.suffix.lower() not in PHOTO_SUFFIXES:
            listing.ignored += 1
            continue
        keys.append(info.key)
        if len(keys) > max_photos:
            raise TooLarge(
                "too_many_photos",
                f"There are more than {max_photos} photos below {prefix} (MAX_BATCH_PHOTOS). "
                "Name a longer prefix.",
            )
    if not keys:
        raise Unprocessable("no_photos", f"The object store has no photo below {prefix}.")
    listing.items = [_object_item(key) for key in sorted(keys)]
    return listing


def _object_item(key: str) -> dict[str, Any]:
    item: dict[str, Any] = {"name": key, "object_key": key}
    try:
        return {**item, "fields": upload_fields_of_file_name(PurePosixPath(key).name, None)}
    except PlacewiseError as error:
        return {**item, "state": JobState.FAILED, "error": error.as_problem()}
