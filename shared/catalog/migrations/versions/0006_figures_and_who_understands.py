"""figures of large maps are kept; the schema says which releases understand it"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None
understood_from = "0006"  # the first that looks

JSON_VALUE = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")


def upgrade() -> None:
    op.create_table(
        "schema_compatibility",
        sa.Column("understood_from", sa.String(length=32), nullable=False),
        sa.PrimaryKeyConstraint("understood_from", name="pk_schema_compatibility"),
    )
    op.create_table(
        "map_figures",
        sa.Column("map_id", sa.Uuid(), nullable=False),
        sa.Column("figures", JSON_VALUE, nullable=False),
        sa.Column("counted_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("took_seconds", sa.Float(), nullable=False),
        sa.ForeignKeyConstraint(["map_id"], ["maps.id"], name="fk_map_figures_map_id"),
        sa.PrimaryKeyConstraint("map_id", name="pk_map_figures"),
    )
    if op.get_context().dialect.name == "postgresql":
        # As pg_trgm would, without an extension that someone has to install and allow.
        op.execute(
            "CREATE FUNCTION placewise_trigrams(text) RETURNS text[] "
            "LANGUAGE sql IMMUTABLE STRICT PARALLEL SAFE AS $$"
            "SELECT array_agg(substr(lower($1), i, 3))"
            " FROM generate_series(1, length(lower($1)) - 2) AS i"
            "$$"
        )
