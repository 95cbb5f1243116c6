"""The tables of this version: what the classes of `shared.catalog` describe.

Until the first release there is this one revision, which is named by what it creates
(`schema_revision`). With the first release, replace `create_all` by the statements that it runs
then, give the revision a fixed name, and add later changes as migrations of their own.
"""

from __future__ import annotations

from alembic import op

from shared.catalog.database.base import Base
from shared.catalog.database.schema import schema_revision

revision = schema_revision()
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    Base.metadata.create_all(op.get_bind())
