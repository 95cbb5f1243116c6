"""rows are marked for the journal in the object store; all rows that are there are pending"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0016"
down_revision = "0015"
branch_labels = None
depends_on = None

JOURNALED = ("photos", "maps", "models", "vocabularies", "whitenings", "generations")


def upgrade() -> None:
    for table in JOURNALED:
        op.add_column(
            table, sa.Column("revision", sa.BigInteger(), server_default="1", nullable=False)
        )
        op.add_column(
            table,
            sa.Column("journaled_revision", sa.BigInteger(), server_default="0", nullable=False),
        )
    op.add_column(
        "installation",
        sa.Column("journal_sequence", sa.BigInteger(), server_default="0", nullable=False),
    )
