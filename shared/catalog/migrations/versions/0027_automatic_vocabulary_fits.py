"""automatic vocabulary fits"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0027"
down_revision = "0026"
branch_labels = None
depends_on = None

# An imported vocabulary was a decision. A map whose vocabulary was fitted is due when it has twice
# its present photos; they are not counted, but summed over chunks, because the table is locked.
# Rows that are changed have to be journaled.
SWITCH_OFF = """
UPDATE maps SET auto_fit = false, revision = revision + 1
WHERE EXISTS (
    SELECT 1 FROM generations g JOIN vocabularies v ON v.id = g.vocabulary_id
    WHERE g.map_id = maps.id AND g.state = 'active' AND v.origin = 'imported'
)
"""
SET_FITTED_PHOTOS = """
UPDATE maps SET revision = revision + 1, fitted_photos = (
    SELECT coalesce(sum(c.rows), 0) FROM generations g JOIN chunks c ON c.generation_id = g.id
    WHERE g.map_id = maps.id AND g.state = 'active' AND c.superseded_at IS NULL
)
WHERE EXISTS (
    SELECT 1 FROM generations g JOIN vocabularies v ON v.id = g.vocabulary_id
    WHERE g.map_id = maps.id AND g.state = 'active' AND v.origin = 'fitted'
)
"""


def upgrade() -> None:
    op.add_column(
        "maps", sa.Column("auto_fit", sa.Boolean(), server_default=sa.true(), nullable=False)
    )
    op.add_column("maps", sa.Column("fitted_photos", sa.Integer(), nullable=True))
    op.execute(SWITCH_OFF)
    op.execute(SET_FITTED_PHOTOS)
