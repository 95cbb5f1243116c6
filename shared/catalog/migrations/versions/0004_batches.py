"""batches: what becomes of each photo of a batch"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

JSON_VALUE = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")


def upgrade() -> None:
    op.create_table(
        "batch_items",
        sa.Column("job_id", sa.Uuid(), nullable=False),
        sa.Column("number", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("state", sa.String(length=20), nullable=False),
        sa.Column("object_key", sa.Text(), nullable=True),
        sa.Column("source", JSON_VALUE, nullable=False),
        sa.Column("fields", JSON_VALUE, nullable=False),
        sa.Column("line", sa.Integer(), nullable=True),
        sa.Column("photo_id", sa.Uuid(), nullable=True),
        sa.Column("photo_job_id", sa.Uuid(), nullable=True),
        sa.Column("already_there", sa.Boolean(), nullable=False),
        sa.Column("error", JSON_VALUE, nullable=True),
        sa.ForeignKeyConstraint(
            ["job_id"], ["jobs.id"], name="fk_batch_items_job_id", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("job_id", "number", name="pk_batch_items"),
    )
    op.create_index("ix_batch_items_state", "batch_items", ["job_id", "state", "number"])
    op.create_index(
        "ix_batch_items_object_key",
        "batch_items",
        ["object_key"],
        postgresql_where=sa.text("object_key IS NOT NULL"),
        sqlite_where=sa.text("object_key IS NOT NULL"),
    )
