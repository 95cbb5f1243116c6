"""tracks and their frames"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0022"
down_revision = "0021"
branch_labels = None
depends_on = None

JSON_VALUE = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")
TIME = sa.DateTime(timezone=True)


def upgrade() -> None:
    op.create_table(
        "tracks",
        sa.Column("id", sa.Uuid(), nullable=False),
        sa.Column("map_id", sa.Uuid(), nullable=False),
        sa.Column("params", JSON_VALUE, nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("revision", sa.Integer(), nullable=False),
        sa.Column("created_at", TIME, nullable=False),
        sa.Column("updated_at", TIME, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_tracks"),
        sa.ForeignKeyConstraint(["map_id"], ["maps.id"], name="fk_tracks_map_id_maps"),
    )
    op.create_index("ix_tracks_map_id", "tracks", ["map_id", "id"])
    op.create_index("ix_tracks_updated_at", "tracks", ["updated_at"])
    op.create_table(
        "track_frames",
        sa.Column("id", sa.Uuid(), nullable=False),
        sa.Column("track_id", sa.Uuid(), nullable=False),
        sa.Column("captured_at", TIME, nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("job_id", sa.Uuid(), nullable=False),
        sa.Column("filename", sa.Text(), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("measurements", JSON_VALUE, nullable=False),
        sa.Column("evidence", JSON_VALUE, nullable=True),
        sa.Column("state", JSON_VALUE, nullable=True),
        sa.Column("error", JSON_VALUE, nullable=True),
        sa.Column("belief", sa.LargeBinary(), nullable=True),
        sa.PrimaryKeyConstraint("id", name="pk_track_frames"),
        sa.ForeignKeyConstraint(
            ["track_id"], ["tracks.id"], name="fk_track_frames_track_id_tracks"
        ),
        sa.UniqueConstraint("track_id", "captured_at", name="uq_track_frames_track_id_captured_at"),
    )
    op.create_index("ix_track_frames_job_id", "track_frames", ["job_id"])
    for name, condition in (
        ("ix_track_frames_pending", "state IS NULL AND error IS NULL"),
        ("ix_track_frames_belief", "belief IS NOT NULL"),
    ):
        op.create_index(
            name,
            "track_frames",
            ["track_id", "captured_at"],
            postgresql_where=sa.text(condition),
            sqlite_where=sa.text(condition),
        )
