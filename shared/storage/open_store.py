"""Which store the settings mean.

UPLOAD_DIR: original photos in a folder of their own, which belongs to one PLACEWISE_HOME.

The folder and the home carry the same mark. A folder that another home uses as well would lose
its photos: each home removes the originals that its own catalog does not know. And a folder that
is not the one of before, such as a disk that is not mounted, holds none of the photos.
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
from shared.storage.folder import OWNER_MARK, FolderStore
from shared.storage.keys import ORIGINALS, check_import_prefix
from shared.storage.protocol import OwnedStore
from shared.storage.s3 import Bucket, S3Store

ORIGINALS_FOLDER = ORIGINALS.rstrip("/")


def resolve_upload_dir(home: Path, objects: Path, upload_dir: Path | None) -> Mapping[str, Path]:
    """What lies outside of `objects`, as FolderStore wants it: {} or the originals.

    Marks a folder that is used for the first time. Raises Misconfigured: `upload_dir_overlaps`,
    `upload_dir_unwritable`, `upload_dir_taken` for another home's, and `upload_dir_changed` where
    the photos that the home has would be out of reach.
    """
    note = home / "upload-dir.json"
    before: dict[str, str] = json.loads(note.read_text()) if note.exists() else {}
    if upload_dir is None:
        if before:
            raise Misconfigured(
                "upload_dir_changed",
                f"The photos lie in {before['folder']}, and UPLOAD_DIR is not set. Set it; or move "
                f"what is in that folder to {objects / ORIGINALS_FOLDER} and delete {note}.",
            )
        return {}
    _check_apart(objects, upload_dir)
    mark = upload_dir / OWNER_MARK
    try:
        make_private_folder(upload_dir)
        found = mark.read_text().strip() if mark.exists() else None
        if not os.access(upload_dir, os.W_OK | os.X_OK):
            raise PermissionError(0, "this user may not write there")
        if found is None:
            if before:
                raise Misconfigured(
                    "upload_dir_changed",
                    f"The photos lie in {before['folder']}, and UPLOAD_DIR is {upload_dir}, which "
                    f"has no {OWNER_MARK} of that folder. Is its disk mounted? To move the "
                    "photos: all "
                    f"that is in {before['folder']}, {OWNER_MARK} too.",
                )
            _check_none_stored(objects / ORIGINALS_FOLDER, upload_dir)
            found = str(new_id())
            write_private(mark, f"{found}\n")
        elif found != before.get("id"):
            raise Misconfigured(
                "upload_dir_taken",
                f"The folder {upload_dir} (UPLOAD_DIR) belongs to another PLACEWISE_HOME than "
                f"{home}. Give this one a folder of its own; or, if the other one is gone, delete "
                f"{mark}.",
            )
    except OSError as error:
        raise Misconfigured(
            "upload_dir_unwritable",
            f"Can't write into the folder {upload_dir} (UPLOAD_DIR): {error.strerror}. Check its "
            "permissions, or choose another one.",
        ) from error
    now = {"folder": str(upload_dir), "id": found}
    if now != before:
        write_private(note, json.dumps(now))
    return {ORIGINALS_FOLDER: upload_dir}


def _check_apart(objects: Path, upload_dir: Path) -> None:
    if upload_dir.is_relative_to(objects) or objects.is_relative_to(upload_dir):
        raise Misconfigured(
            "upload_dir_overlaps",
            f"UPLOAD_DIR is {upload_dir}, and the other objects lie in {objects}: neither may lie "
            "inside the other. Choose another UPLOAD_DIR, or unset it.",
        )


def _check_none_stored(originals: Path, upload_dir: Path) -> None:
    if originals.is_dir() and any(originals.iterdir()):
        raise Misconfigured(
            "upload_dir_changed",
            f"Photos lie in {originals} already, and would be out of reach. Unset UPLOAD_DIR, or "
            f"move them first, for example: mv {originals}/* {upload_dir}/",
        )


def open_store(settings: Settings, *, exclusive: bool = True) -> OwnedStore:
    """The bucket at S3_ENDPOINT, else the folder PLACEWISE_HOME/objects with UPLOAD_DIR.

    `exclusive` says that no other process writes there: a folder is then tidied of half-written
    files.
    Asks nothing of an S3 server: `check` does. Whether the store is the catalog's own is for
    `shared.catalog.installation` to say. Raises Misconfigured as `resolve_upload_dir` does, and
    `bad_setting` for an IMPORT_PREFIX that is none.
    """
    check_import_prefix(settings.import_prefix)
    if settings.s3_endpoint is not None:
        return S3Store(Bucket.from_settings(settings))
    home = settings.placewise_home
    objects = home / "objects"
    elsewhere = resolve_upload_dir(home, objects, settings.upload_dir)
    return FolderStore(objects, elsewhere, alone=exclusive)
