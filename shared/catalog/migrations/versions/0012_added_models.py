"""models that were trained can be added, under names of their own"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None

JSON_VALUE = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")


def upgrade() -> None:
    for column in (
        sa.Column("added_name", sa.String(length=100), nullable=True),
        sa.Column("added_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("object_key", sa.Text(), nullable=True),
        sa.Column("sha256", sa.String(length=64), nullable=True),
        sa.Column("size_bytes", sa.BigInteger(), nullable=True),
        sa.Column("dimension", sa.Integer(), nullable=True),
        sa.Column("config", JSON_VALUE, nullable=True),
        sa.Column("note", sa.Text(), nullable=True),
    ):
        op.add_column("models", column)
    op.create_index("uq_models_added_name", "models", ["added_name"], unique=True)
