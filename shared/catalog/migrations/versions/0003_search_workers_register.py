"""search workers register; a generation is switched in once they have loaded it"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None

JSON_VALUE = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")


def upgrade() -> None:
    op.create_table(
        "search_workers",
        sa.Column("id", sa.Uuid(), nullable=False),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("url", sa.Text(), nullable=True),
        sa.Column("shard", sa.Integer(), nullable=False),
        sa.Column("shards", sa.Integer(), nullable=False),
        sa.Column("loaded", JSON_VALUE, nullable=False),
        sa.Column("started_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("seen_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_search_workers"),
    )
    op.add_column("generations", sa.Column("complete_version", sa.BigInteger(), nullable=True))
    op.add_column(
        "generations", sa.Column("complete_at", sa.DateTime(timezone=True), nullable=True)
    )
    op.add_column("jobs", sa.Column("awaited", JSON_VALUE, nullable=True))
