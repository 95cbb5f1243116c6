"""Search workers: who lives, which shard it holds, which versions it has loaded.

Written by the workers about every second or two. What a worker says here is a promise about its
memory: it is why a generation is switched in only once it can be answered from.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any
from uuid import UUID

from sqlalchemy import Integer, String, Text, Uuid, delete, select, update
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.base import Base, JsonValue, UtcDateTime, db_now, db_now_plus, rowcount
from shared.catalog.chunks import Chunk
from shared.ids import new_id
from shared.shards import Shard

UNREADABLE = "unreadable"
"""In `loaded`, beside the generations: the keys of the chunks that the worker can't read."""

# Several heartbeats: a worker that was silent for longer holds up nothing any more.
DEAD_SECONDS = 10.0


class RegisteredWorker(Base):
    """One process that answers searches. `loaded`: generation id -> version without a gap, and
    `UNREADABLE`."""

    __tablename__ = "search_workers"

    id: Mapped[UUID] = mapped_column(Uuid, primary_key=True, default=new_id)
    name: Mapped[str] = mapped_column(String(200))
    url: Mapped[str | None] = mapped_column(Text)
    shard: Mapped[int] = mapped_column(Integer)
    shards: Mapped[int] = mapped_column(Integer)
    loaded: Mapped[dict[str, Any]] = mapped_column(JsonValue, default=dict)
    started_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    seen_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())

    def has(self, generation_id: UUID, version: int) -> bool:
        """Whether it has loaded the generation at this version or a later one."""
        return int(self.loaded.get(str(generation_id), -1)) >= version


def tell_of_worker(
    session: Session,
    worker_id: UUID,
    name: str,
    url: str | None,
    shard: Shard,
    loaded: Mapping[UUID, int],
    unreadable: Sequence[str] = (),
) -> None:
    """The worker lives, has loaded these versions, and can't read these chunks."""
    versions: dict[str, Any] = {str(id_): version for id_, version in loaded.items()}
    if unreadable:
        versions[UNREADABLE] = list(unreadable)
    known = session.execute(
        update(RegisteredWorker)
        .where(RegisteredWorker.id == worker_id)
        .values(loaded=versions, seen_at=db_now())
        .execution_options(synchronize_session=False)
    )
    if not rowcount(known):  # new, or removed while it could not reach the catalog
        session.add(
            RegisteredWorker(
                id=worker_id,
                name=name,
                url=url,
                shard=shard.index,
                shards=shard.of,
                loaded=versions,
            )
        )


def forget_worker(session: Session, worker_id: UUID) -> None:
    """The worker has ended."""
    session.execute(delete(RegisteredWorker).where(RegisteredWorker.id == worker_id))


def forget_dead_workers(session: Session, *, everyone: bool = False) -> int:
    """Remove the workers that are dead; `everyone`, where none can live."""
    dead = delete(RegisteredWorker)
    if not everyone:
        dead = dead.where(RegisteredWorker.seen_at < db_now_plus(-DEAD_SECONDS))
    return rowcount(session.execute(dead))


def unreadable_keys(session: Session) -> set[str]:
    """The chunks that a live worker reports as unreadable."""
    live = session.scalars(
        select(RegisteredWorker.loaded).where(
            RegisteredWorker.seen_at >= db_now_plus(-DEAD_SECONDS)
        )
    )
    return {key for loaded in live for key in loaded.get(UNREADABLE, ())}


def workers_without(session: Session, generation_id: UUID, version: int) -> list[RegisteredWorker]:
    """The live workers that hold a part of the generation and have not loaded it at `version`
    yet, by name. A worker whose shard has no row of it has nothing to load."""
    slots = session.scalars(
        select(Chunk.slot)
        .where(Chunk.generation_id == generation_id, Chunk.superseded_at.is_(None))
        .distinct()
    ).all()
    live = session.scalars(
        select(RegisteredWorker)
        .where(RegisteredWorker.seen_at >= db_now_plus(-DEAD_SECONDS))
        .order_by(RegisteredWorker.name, RegisteredWorker.id)
    )
    return [
        worker
        for worker in live
        if any(Shard(worker.shard, worker.shards).owns(slot) for slot in slots)
        and not worker.has(generation_id, version)
    ]
