"""Which store the settings mean."""

from __future__ import annotations

from shared.objects.folder import FolderStore
from shared.objects.keys import check_import_prefix
from shared.objects.port import OwnedStore
from shared.objects.s3 import Bucket, S3Store
from shared.objects.upload_dir import resolve_upload_dir
from shared.settings import Settings


def open_store(settings: Settings, *, exclusive: bool = True) -> OwnedStore:
    """The bucket at S3_ENDPOINT, else the folder PLACEWISE_HOME/objects with UPLOAD_DIR.

    `exclusive` says that no other process writes there: a folder is then tidied of half-written files.
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
