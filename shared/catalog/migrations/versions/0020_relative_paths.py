"""photos keep the path that they had in their folder or archive"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0020"
down_revision = "0019"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("photos", sa.Column("relative_path", sa.Text(), nullable=True))
