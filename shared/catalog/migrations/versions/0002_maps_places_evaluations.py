"""maps can go, photos have a role, generations are evaluated"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

JSON_VALUE = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")


def upgrade() -> None:
    op.add_column("maps", sa.Column("deleted_at", sa.DateTime(timezone=True), nullable=True))
    op.add_column(
        "photos", sa.Column("role", sa.String(length=10), nullable=False, server_default="database")
    )
    op.create_index("ix_photos_map_position", "photos", ["map_id", "latitude", "longitude"])
    op.add_column("generations", sa.Column("calibration", JSON_VALUE, nullable=True))
    op.add_column("searches", sa.Column("best_score", sa.Float(), nullable=True))
    op.add_column("searches", sa.Column("in_map", sa.Boolean(), nullable=True))
    op.create_index("ix_searches_map_id", "searches", ["map_id", "id"])
    op.create_table(
        "evaluations",
        sa.Column("id", sa.Uuid(), nullable=False),
        sa.Column("map_id", sa.Uuid(), nullable=False),
        sa.Column("generation_id", sa.Uuid(), nullable=False),
        sa.Column("automatic", sa.Boolean(), nullable=False),
        sa.Column("searchable", sa.Integer(), nullable=False),
        sa.Column("labelled_queries", sa.Integer(), nullable=False),
        sa.Column("figures", JSON_VALUE, nullable=False),
        sa.Column("evaluated_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["map_id"], ["maps.id"], name="fk_evaluations_map_id"),
        sa.ForeignKeyConstraint(
            ["generation_id"], ["generations.id"], name="fk_evaluations_generation_id"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_evaluations"),
    )
    op.create_index("ix_evaluations_map_id", "evaluations", ["map_id", "id"])
    op.create_index("ix_evaluations_generation", "evaluations", ["generation_id", "id"])
