"""photos are counted by the key that they came in with; built beside the traffic, alone"""

from __future__ import annotations

import sqlalchemy as sa

from shared.catalog.migrations.online import create_index

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None


def upgrade() -> None:
    of_a_key = sa.text("deleted_at IS NULL AND key_id IS NOT NULL")
    create_index(
        "ix_photos_key",
        "photos",
        ["key_id"],
        unique=False,
        postgresql_where=of_a_key,
        sqlite_where=of_a_key,
    )
