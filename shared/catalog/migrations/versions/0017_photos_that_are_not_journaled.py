"""an index of the photos that the journal does not know yet; built beside the traffic, alone"""

from __future__ import annotations

import sqlalchemy as sa

from shared.catalog.migrations.online import create_index

revision = "0017"
down_revision = "0016"
branch_labels = None
depends_on = None


def upgrade() -> None:
    pending = sa.text("revision != journaled_revision")
    create_index(
        "ix_photos_not_journaled",
        "photos",
        ["id"],
        unique=False,
        postgresql_where=pending,
        sqlite_where=pending,
    )
