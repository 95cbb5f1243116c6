"""Lists the photos of an archive, or of a prefix of the object store, as items of a batch.

An archive may contain a manifest (`photos.csv` or `manifest.jsonl`) with fields of its photos.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any

from services.steward.archives.archive import Archive, ArchiveMember, MemberKind
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
from shared.utm_filenames import upload_fields_of_file_name

TABLE_NAME, MANIFEST_NAME = "photos.csv", "manifest.jsonl"
# Suffixes of nested archives, which are not unpacked.
ARCHIVE_SUFFIXES = {".zip", ".tar", ".tgz", ".gz", ".bz2", ".xz", ".zst", ".7z", ".rar"}
MAX_LABEL_CHARACTERS = 1000


@dataclass(slots=True)
class BatchListing:
    """The items of a batch."""

    items: list[dict[str, Any]] = field(default_factory=list)
    """Columns of BatchItem."""
    ignored: int = 0
    """Number of members or objects that are not photos: folders, texts, system files."""


def list_archive_photos(archive: Archive) -> BatchListing:
    """List the photos of an archive with the fields of its manifest and of their file names.

    An item that can't be imported is listed as failed, with its error.

    Raises:
        Unprocessable: `no_photos`, or as `Archive.members` raises.
        InvalidRequest: `bad_table`, `bad_manifest` or `several_manifests`.
        TooLarge: `manifest_too_large`, or as `Archive.members` raises.
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
            "no_photos", f"The archive has no photos ({', '.join(sorted(PHOTO_SUFFIXES))})."
        )
    manifest_lines = _read_table(archive, tables, {name for name, _ in photos})
    listing.items = list(_to_items(photos, manifest_lines))
    return listing


def _display_name(name: str) -> str:
    """Return the member's name for display and for its manifest line; never used as a path."""
    printable = "".join(c for c in name.replace("\\", "/") if c.isprintable())
    return printable.removeprefix("./")[:MAX_LABEL_CHARACTERS] or "photo"


def _is_system_file(path: PurePosixPath) -> bool:
    """Return whether it is hidden or made by macOS: `__MACOSX/`, `._a.jpg`, `.git/`."""
    return any(
        part == "__MACOSX" or (part.startswith(".") and part not in (".", ".."))
        for part in path.parts
    )


def _read_table(
    archive: Archive, tables: list[tuple[str, ArchiveMember]], names: set[str]
) -> dict[str, ManifestEntry]:
    """Read the outermost manifest; return its lines by photo name."""
    if not tables:
        return {}
    depth = min(name.count("/") for name, _ in tables)
    outermost = [(name, member) for name, member in tables if name.count("/") == depth]
    if len(outermost) > 1:
        raise InvalidRequest(
            "several_manifests",
            f"The archive has several manifests: {', '.join(name for name, _ in outermost[:5])}. "
            "Remove all but one.",
        )
    [(manifest_name, member)] = outermost
    if member.size_bytes > MAX_MANIFEST_BYTES:
        raise TooLarge(
            "manifest_too_large", f"{manifest_name} is larger than {MAX_MANIFEST_BYTES} bytes."
        )
    data = b"".join(archive.read(member))
    is_table = manifest_name.endswith(TABLE_NAME)
    read_manifest = read_csv_manifest if is_table else read_jsonl_manifest
    # Names in it are relative to its folder, because users pack a folder with its manifest.
    folder = manifest_name[: manifest_name.rfind("/") + 1]
    lines = {folder + _display_name(line.name): line for line in read_manifest(data, manifest_name)}
    unknown = [
        (line.line, f"the archive has no photo {name!r}")
        for name, line in lines.items()
        if name not in names
    ]
    if unknown:
        code = "bad_table" if is_table else "bad_manifest"
        raise bad_lines_error(code, manifest_name, unknown[:MAX_REPORTED_LINES])
    return lines


def _to_items(
    photos: list[tuple[str, ArchiveMember]], manifest_lines: dict[str, ManifestEntry]
) -> Iterator[dict[str, Any]]:
    name_counts = Counter(name for name, _ in photos)
    for name, member in photos:
        line = manifest_lines.get(name)
        item: dict[str, Any] = {
            "name": name,
            "source": _member_location(member),
            "line": line.line if line else None,
        }
        try:
            item["fields"] = _validate_member(name, member, line, name_counts[name])
        except PlacewiseError as error:
            item |= {"state": JobState.FAILED, "error": error.as_problem()}
        yield item


def _validate_member(
    name: str, member: ArchiveMember, manifest_line: ManifestEntry | None, name_count: int
) -> dict[str, str]:
    """Return the photo's fields; raise the reason if it is already known not to be importable."""
    if member.fault is not None:
        raise member.fault
    path = PurePosixPath(name)
    if path.suffix.lower() in ARCHIVE_SUFFIXES:
        raise UnsupportedMedia(
            "nested_archive", "An archive in an archive is not unpacked. Upload it separately."
        )
    if manifest_line is not None and name_count > 1:
        raise Unprocessable(
            "ambiguous_name",
            f"The archive has {name_count} photos named {name!r}, so line {manifest_line.line} of "
            "its manifest is ambiguous. Rename them.",
        )
    return {
        **upload_fields_of_file_name(path.name, None),
        **(manifest_line.fields if manifest_line else {}),
    }


def _member_location(member: ArchiveMember) -> dict[str, Any]:
    """Return the location of a member as JSON, for `member_from_location`."""
    return {"offset": member.offset, "size_bytes": member.size_bytes}


def member_from_location(name: str, location: dict[str, Any]) -> ArchiveMember:
    """Return the member at a location that `_member_location` returned."""
    return ArchiveMember(name, MemberKind.FILE, location["offset"], location["size_bytes"])


def list_prefix_photos(store: ObjectStore, prefix: str, max_photos: int) -> BatchListing:
    """List the photos under a prefix by key, with the fields in their file names.

    Objects without a photo suffix and hidden ones are ignored and counted.

    Raises:
        Unprocessable: `no_photos`.
        TooLarge: `too_many_photos`: there are more than `max_photos`.
        Unavailable: The object store can't be reached.
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
                f"There are more than {max_photos} photos under {prefix} (MAX_BATCH_PHOTOS). "
                "Use a longer prefix.",
            )
    if not keys:
        raise Unprocessable("no_photos", f"The object store has no photos under {prefix}.")
    listing.items = [_object_item(key) for key in sorted(keys)]
    return listing


def _object_item(key: str) -> dict[str, Any]:
    item: dict[str, Any] = {"name": key, "object_key": key}
    try:
        return {**item, "fields": upload_fields_of_file_name(PurePosixPath(key).name, None)}
    except PlacewiseError as error:
        return {**item, "state": JobState.FAILED, "error": error.as_problem()}
