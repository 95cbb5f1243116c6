"""maps say whether their place labels are paths"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0018"
down_revision = "0017"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column(
        "maps",
        sa.Column(
            "place_labels_are_paths", sa.Boolean(), server_default=sa.false(), nullable=False
        ),
    )
