"""Marks rows that the journal in the object store has to be told of (`shared.journal`)."""

from __future__ import annotations

from sqlalchemy import BigInteger, text
from sqlalchemy.orm import Mapped, mapped_column

from shared.catalog.base import Condition


class Journaled:
    """Mixin of tables whose rows are written to the journal.

    Every INSERT and UPDATE that goes through SQLAlchemy raises `revision`, in the same transaction.
    A row whose `revision` differs from `journaled_revision` is pending.
    """

    revision: Mapped[int] = mapped_column(
        BigInteger, default=1, server_default="1", onupdate=text("revision + 1")
    )
    journaled_revision: Mapped[int] = mapped_column(BigInteger, default=0, server_default="0")


def is_journaled(table: type[Journaled]) -> Condition:
    """True for rows whose present state is in the journal."""
    return table.revision == table.journaled_revision
