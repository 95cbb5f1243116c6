"""an index for parts of relative paths"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from shared.catalog.migrations.online import create_index

revision = "0028"
down_revision = "0027"
branch_labels = None
depends_on = None


def upgrade() -> None:
    if op.get_context().dialect.name == "postgresql":
        create_index(
            "ix_photos_relative_path",
            "photos",
            [sa.text("placewise_trigrams(relative_path)")],
            postgresql_using="gin",
            postgresql_where=sa.text("deleted_at IS NULL"),
        )
