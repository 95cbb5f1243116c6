"""The hold: a note in the store that says why orphans are not collected until someone decides.

The steward writes it, `placewise doctor` reads it, and `placewise storage collect --confirm` ends
it.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from enum import StrEnum

from shared.objects.folder import OWNER_MARK
from shared.objects.port import OwnedStore

HOLD = f"{OWNER_MARK}-hold"


class HoldReason(StrEnum):
    SHARE = "share"
    """More than COLLECT_MAX_SHARE of all objects are orphans."""
    ADOPTED = "adopted"
    """A catalog became the owner that did not know some of the objects."""
    CATALOG_BEHIND = "catalog_behind"
    """The catalog is older than the store."""


@dataclass(frozen=True, slots=True)
class Hold:
    reason: HoldReason
    orphans: int
    orphan_bytes: int
    objects: int
    """All objects of the prefixes in which orphans are looked for."""

    def describe(self) -> str:
        """What is held, why, and what the operator can do: whole sentences."""
        why = {
            HoldReason.SHARE: "that is more than COLLECT_MAX_SHARE allows",
            HoldReason.ADOPTED: "this catalog adopted the store without knowing them",
            HoldReason.CATALOG_BEHIND: "the catalog is older than the store",
        }[self.reason]
        return (
            f"{self.orphans} of {self.objects} objects ({self.orphan_bytes / 1e6:.1f} MB) are "
            f"known to no row of the catalog, and {why}: nothing was collected. If the catalog is "
            "not the right one, put the right one back, or run `placewise verify --repair`. If "
            "they are garbage: `placewise storage collect` lists them, and with --confirm it moves "
            "them to the trash."
        )


def read_hold(store: OwnedStore) -> Hold | None:
    note = store.read_note(HOLD)
    if note is None:
        return None
    fields = json.loads(note)
    return Hold(**{**fields, "reason": HoldReason(fields["reason"])})


def write_hold(store: OwnedStore, hold: Hold) -> None:
    store.write_note(HOLD, json.dumps(asdict(hold)).encode())


def end_hold(store: OwnedStore) -> None:
    store.delete_note(HOLD)
