"""tracks and frames are counted by key"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0025"
down_revision = "0024"
branch_labels = None
depends_on = None


def upgrade() -> None:
    for table in ("tracks", "track_frames"):
        op.add_column(table, sa.Column("key_id", sa.Uuid(), nullable=True))
