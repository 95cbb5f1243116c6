"""Object store checks of `placewise doctor`: owner, garbage collection, file permissions."""

from __future__ import annotations

from pathlib import Path
from uuid import UUID

from sqlalchemy import select

from services.cli.operations.deployment_checks import open_for_check
from shared.catalog.installation import Installation
from shared.catalog.tables import open_catalog
from shared.config.private_files import is_open_to_others
from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.storage import FolderStore, OwnedStore
from shared.storage.open_store import open_store
from shared.storage.ownership import read_owner, store_taken_error
from shared.storage.trash import read_hold

CHECK_FILE = "Check its permissions, or restore it from a backup."


def collection_check(settings: Settings) -> str:
    """Check that this catalog owns the store and that orphans are collected.

    Raises:
        Misconfigured: Another catalog owns the store, or `collection_held`.
    """
    folder = settings.placewise_home / "objects"
    store: OwnedStore
    if settings.s3_endpoint is not None:
        store = open_store(settings, exclusive=False)
    elif folder.exists():
        store = FolderStore(folder, exclusive=False)  # UPLOAD_DIR has no owner record
    else:
        return "nothing is stored yet"
    owner = read_owner(store)
    if owner is None:
        return "the object store has no owner yet; the next start assigns it"
    if str(_installation_id(settings)) != owner:
        raise store_taken_error(store, "belongs to another catalog than this one")
    hold = read_hold(store)
    if hold is not None:
        raise Misconfigured("collection_held", hold.describe())
    return "the object store belongs to this catalog, and orphans are collected"


def permissions_check(settings: Settings) -> str:
    """Check that other users of this machine can't read stored files.

    Raises:
        Misconfigured: `readable_by_others`.
    """
    roots = [settings.placewise_home, settings.upload_dir, _sqlite_file(settings)]
    existing = [root for root in roots if root is not None and root.exists()]
    # Contents of a private folder are not accessible, whatever their own permissions.
    accessible = [
        root
        for root in existing
        if is_open_to_others(root)
        and not any(_is_private_parent(parent, root) for parent in existing)
    ]
    if accessible:
        paths = " ".join(f"'{root}'" for root in accessible)
        raise Misconfigured(
            "readable_by_others",
            f"Other users of this machine have access to {paths}, which contain photos, key hashes "
            f"and the catalog. Revoke it: chmod -R go-rwx {paths}",
        )
    return "only this user can read stored files" if existing else "nothing is stored yet"


def _is_private_parent(parent: Path, path: Path) -> bool:
    return path != parent and path.is_relative_to(parent) and not is_open_to_others(parent)


def _sqlite_file(settings: Settings) -> Path | None:
    catalog = open_catalog(settings, "doctor")  # opens no connection
    catalog.close()
    return Path(catalog.url.database) if catalog.is_sqlite and catalog.url.database else None


def _installation_id(settings: Settings) -> UUID | None:
    """None for a catalog that does not exist."""
    file = _sqlite_file(settings)
    if file is not None and not file.exists():
        return None
    with open_for_check(settings, CHECK_FILE) as catalog, catalog.read() as session:
        return session.scalar(select(Installation.id))
