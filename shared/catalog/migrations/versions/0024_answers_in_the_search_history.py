"""levels of answers in the search history"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0024"
down_revision = "0023"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("searches", sa.Column("answer_level", sa.Integer(), nullable=True))
    op.add_column("searches", sa.Column("not_in_map_probability", sa.Float(), nullable=True))
