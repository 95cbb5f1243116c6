"""maps decide by their labels whether these are paths; searches say whether they found a place"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0029"
down_revision = "0028"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column(
        "maps",
        sa.Column(
            "place_labels_are_automatic", sa.Boolean(), server_default=sa.true(), nullable=False
        ),
    )
    # Rows that are changed have to be journaled.
    op.execute(
        "UPDATE maps SET place_labels_are_automatic = false, revision = revision + 1 "
        "WHERE place_labels_are_paths"
    )
    op.add_column(
        "searches",
        sa.Column("has_place", sa.Boolean(), server_default=sa.false(), nullable=False),
    )
