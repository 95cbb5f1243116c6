"""an index for every query; built beside the traffic, so this migration does nothing else"""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op

from shared.catalog.migrations.online import create_index, drop_index

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

READY = "state IN ('queued', 'running') AND lease_token IS NULL AND waiting_for IS NULL"
FIRST_FIRST: Any = sa.literal_column("priority DESC")


def upgrade() -> None:
    live = "deleted_at IS NULL"
    _create("ix_photos_object_key", "photos", ["object_key"])
    _create("ix_photos_map_size", "photos", ["map_id", "size_bytes"], live)
    _create(
        "ix_photos_map_captured",
        "photos",
        ["map_id", "captured_at"],
        f"{live} AND captured_at IS NOT NULL",
    )
    _create("ix_photos_map_place", "photos", ["map_id", "place"], f"{live} AND place IS NOT NULL")
    _create("ix_photos_map_labelled", "photos", ["map_id", "id"], f"{live} AND role = 'query'")
    if op.get_context().dialect.name == "postgresql":
        gin: dict[str, Any] = {"postgresql_using": "gin", "postgresql_where": sa.text(live)}
        ops = {"tags": "jsonb_path_ops"}
        create_index("ix_photos_tags", "photos", ["tags"], postgresql_ops=ops, **gin)
        trigrams = sa.text("placewise_trigrams(filename)")
        create_index("ix_photos_filename", "photos", [trigrams], **gin)
    _create("ix_jobs_ready", "jobs", [FIRST_FIRST, "id"], READY)
    _create("ix_jobs_ready_batch", "jobs", ["kind", "map_id", FIRST_FIRST, "id"], READY)
    _create("ix_jobs_waiting", "jobs", ["map_id", "waiting_for", "id"], "waiting_for IS NOT NULL")
    _create("ix_jobs_map_listed", "jobs", ["map_id", "id"], "kind != 'reindex'")
    _create("ix_jobs_finished", "jobs", ["finished_at"], "finished_at IS NOT NULL")
    _create("ix_jobs_queries", "jobs", ["created_at"], "kind = 'describe'")
    _create("ix_jobs_map_kind", "jobs", ["map_id", "kind", "id"])
    _create("ix_jobs_kind_waiting", "jobs", ["kind", "waiting_for"])
    _create("ix_jobs_generation_state", "jobs", ["generation_id", "state"])
    _create("ix_searches_time", "searches", ["searched_at"])
    _create("ix_chunks_generation_id", "chunks", ["generation_id"])
    for replaced in ("ix_jobs_claimable", "ix_jobs_finished_kind", "ix_jobs_generation_id"):
        drop_index(replaced, "jobs")


def _create(name: str, table: str, columns: list[Any], only: str | None = None) -> None:
    where = (
        {} if only is None else {"postgresql_where": sa.text(only), "sqlite_where": sa.text(only)}
    )
    create_index(name, table, columns, unique=False, **where)
