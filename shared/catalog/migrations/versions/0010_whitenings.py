"""whitenings: PCA that shortens the descriptors of a generation"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "whitenings",
        sa.Column("id", sa.Uuid(), nullable=False),
        sa.Column("map_id", sa.Uuid(), nullable=False),
        sa.Column("dimension", sa.Integer(), nullable=False),
        sa.Column("kept", sa.Integer(), nullable=False),
        sa.Column("rows", sa.Integer(), nullable=False),
        sa.Column("explained", sa.Float(), nullable=False),
        sa.Column("object_key", sa.Text(), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["map_id"], ["maps.id"], name="fk_whitenings_map_id"),
        sa.PrimaryKeyConstraint("id", name="pk_whitenings"),
    )
    op.create_index("ix_whitenings_map_id", "whitenings", ["map_id"])
    # In one statement: SQLite can't add a constraint to a column that is there.
    uuid = sa.Uuid().compile(op.get_context().dialect)
    op.execute(
        f"ALTER TABLE generations ADD COLUMN whitening_id {uuid} "
        "CONSTRAINT fk_generations_whitening_id REFERENCES whitenings (id)"
    )
    op.create_index("ix_generations_whitening_id", "generations", ["whitening_id"])
