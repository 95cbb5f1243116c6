"""comparisons are collected with query photos; built beside the traffic, so nothing else is here"""

from __future__ import annotations

import sqlalchemy as sa

from shared.catalog.migrations.online import create_index, drop_index

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None


def upgrade() -> None:
    asked = sa.text("kind IN ('describe', 'compare')")
    create_index(
        "ix_jobs_asked",
        "jobs",
        ["created_at"],
        unique=False,
        postgresql_where=asked,
        sqlite_where=asked,
    )
    drop_index("ix_jobs_queries", "jobs")
