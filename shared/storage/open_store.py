"""Opens the object store that the settings select, and checks UPLOAD_DIR.

UPLOAD_DIR is a separate folder of the original photos, which belongs to one PLACEWISE_HOME: both
carry the same id. The check prevents two failures. If two homes used the same folder, each would
delete the originals that its own catalog does not know. If the folder is not the one used before,
for example because its disk is not mounted, all photos would be missing.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path

from shared.config.private_files import make_private_folder, write_private
from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.ids import new_id
from shared.storage.folder import FolderStore
from shared.storage.keys import ORIGINALS, OWNER_MARK
from shared.storage.protocol import OwnedStore

ORIGINALS_FOLDER = ORIGINALS.rstrip("/")


def resolve_upload_dir(home: Path, objects: Path, upload_dir: Path | None) -> Mapping[str, Path]:
    """Return the separate folders for FolderStore: {} or the folder of the originals.

    Marks a folder that is used for the first time.

    Raises:
        Misconfigured: `upload_dir_overlaps`, `upload_dir_unwritable`; `upload_dir_taken` for the
            folder of another home; `upload_dir_changed` where the home's photos would be missing.
    """
    note = home / "upload-dir.json"
    previous: dict[str, str] = json.loads(note.read_text()) if note.exists() else {}
    if upload_dir is None:
        if previous:
            raise Misconfigured(
                "upload_dir_changed",
                f"The photos are in {previous['folder']}, but UPLOAD_DIR is not set. Set it; or "
                f"move that folder's files to {objects / ORIGINALS_FOLDER} and delete {note}.",
            )
        return {}
    _check_no_overlap(objects, upload_dir)
    mark = upload_dir / OWNER_MARK
    try:
        make_private_folder(upload_dir)
        folder_id = mark.read_text().strip() if mark.exists() else None
        if not os.access(upload_dir, os.W_OK | os.X_OK):
            raise PermissionError(0, "permission denied")
        if folder_id is None:
            if previous:
                raise Misconfigured(
                    "upload_dir_changed",
                    f"The photos are in {previous['folder']}, but UPLOAD_DIR is {upload_dir}, "
                    f"which has no file {OWNER_MARK}. Is its disk mounted? If you want to move the "
                    f"photos, move everything in {previous['folder']}, including {OWNER_MARK}.",
                )
            _check_none_stored(objects / ORIGINALS_FOLDER, upload_dir)
            folder_id = str(new_id())
            write_private(mark, f"{folder_id}\n")
        elif folder_id != previous.get("id"):
            raise Misconfigured(
                "upload_dir_taken",
                f"The folder {upload_dir} (UPLOAD_DIR) belongs to another PLACEWISE_HOME than "
                f"{home}. Use a separate folder for each; or, if the other one no longer exists, "
                f"delete {mark}.",
            )
    except OSError as error:
        raise Misconfigured(
            "upload_dir_unwritable",
            f"Can't write to the folder {upload_dir} (UPLOAD_DIR): {error.strerror}. Check its "
            "permissions, or choose another folder.",
        ) from error
    current = {"folder": str(upload_dir), "id": folder_id}
    if current != previous:
        write_private(note, json.dumps(current))
    return {ORIGINALS_FOLDER: upload_dir}


def _check_no_overlap(objects: Path, upload_dir: Path) -> None:
    if upload_dir.is_relative_to(objects) or objects.is_relative_to(upload_dir):
        raise Misconfigured(
            "upload_dir_overlaps",
            f"UPLOAD_DIR is {upload_dir}, and the other objects are in {objects}: neither may be "
            "inside the other. Choose another UPLOAD_DIR, or unset it.",
        )


def _check_none_stored(originals: Path, upload_dir: Path) -> None:
    if originals.is_dir() and any(originals.iterdir()):
        raise Misconfigured(
            "upload_dir_changed",
            f"There are photos in {originals}, which would be missing with UPLOAD_DIR. Unset it, "
            f"or move them first, for example: mv {originals}/* {upload_dir}/",
        )


def open_store(settings: Settings, *, exclusive: bool = True) -> OwnedStore:
    """Open the bucket at S3_ENDPOINT, or the folder PLACEWISE_HOME/objects with UPLOAD_DIR.

    It sends no request to an S3 server (`check` does), and does not check the owner of the store
    (`shared.catalog.installation` does).

    Args:
        exclusive: no other process writes to the folder, so that partial files are deleted.

    Raises:
        Misconfigured: as `resolve_upload_dir`.
    """
    if settings.s3_endpoint is not None:
        from shared.storage.s3 import Bucket, S3Store  # importing minio is slow

        return S3Store(Bucket.from_settings(settings))
    home = settings.placewise_home
    objects = home / "objects"
    separate_folders = resolve_upload_dir(home, objects, settings.upload_dir)
    return FolderStore(objects, separate_folders, exclusive=exclusive)
