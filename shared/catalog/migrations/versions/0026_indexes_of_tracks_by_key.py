"""indexes of the tracks and frames of a key; built beside the traffic, alone"""

from __future__ import annotations

import sqlalchemy as sa

from shared.catalog.migrations.online import create_index

revision = "0026"
down_revision = "0025"
branch_labels = None
depends_on = None


def upgrade() -> None:
    of_a_key = sa.text("key_id IS NOT NULL")
    for table in ("tracks", "track_frames"):
        create_index(
            f"ix_{table}_key",
            table,
            ["key_id"],
            unique=False,
            postgresql_where=of_a_key,
            sqlite_where=of_a_key,
        )
