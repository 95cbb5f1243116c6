"""type of descriptor rows of maps and generations"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0023"
down_revision = "0022"
branch_labels = None
depends_on = None


def upgrade() -> None:
    for table in ("maps", "generations"):
        op.add_column(
            table,
            sa.Column("row_type", sa.String(length=20), server_default="float32", nullable=False),
        )
