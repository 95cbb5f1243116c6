"""Registry and heartbeats of running processes and of search workers.

The registry of gateways, extractors and stewards is informational, for `GET /health` and operators;
leases decide which worker owns a job.

Search workers have a registry of their own with the versions that they have loaded, updated about
every second or two. A generation is activated only once every live worker has registered it as
loaded.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from importlib.metadata import version
from typing import Any
from uuid import UUID

from sqlalchemy import String, Uuid, and_, delete, or_, select, update
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.database.base import (
    Base,
    JsonValue,
    UtcDateTime,
    affected_rows,
    db_now,
    db_now_plus,
)
from shared.catalog.database.errors import OutageLog
from shared.catalog.database.session import Catalog
from shared.ids import new_id

log = logging.getLogger(__name__)

PROCESS_HEARTBEAT_SECONDS = 10.0
STATE_POLL_SECONDS = 0.5
PROCESS_TIMEOUT_SECONDS = 35.0  # three missed heartbeats
PROCESS_RETENTION_SECONDS = 86_400.0


class RegisteredProcess(Base):
    """A running process; `role` is the name of its command, `state` what it reports of itself."""

    __tablename__ = "live_processes"

    id: Mapped[UUID] = mapped_column(Uuid, primary_key=True, default=new_id)
    role: Mapped[str] = mapped_column(String(20))
    name: Mapped[str] = mapped_column(String(200))
    release: Mapped[str] = mapped_column(String(30))
    started_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    seen_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    state: Mapped[dict[str, Any] | None] = mapped_column(JsonValue)


@dataclass(frozen=True, slots=True)
class ProcessStatus:
    """A registered process and the age of its last heartbeat."""

    role: str
    name: str
    release: str
    seconds_since_heartbeat: float
    state: dict[str, Any]

    @property
    def is_live(self) -> bool:
        return self.seconds_since_heartbeat < PROCESS_TIMEOUT_SECONDS


@contextlib.contextmanager
def process_heartbeat(
    catalog: Catalog, role: str, read_state: Callable[[], dict[str, Any] | None] = lambda: None
) -> Iterator[None]:
    """Register this process while the block runs.

    A thread writes a heartbeat with the state every PROCESS_HEARTBEAT_SECONDS, and soon after a
    change of the state; heartbeats are skipped while the catalog is unreachable.
    """
    process_id, stop = new_id(), threading.Event()
    name = f"{socket.gethostname()}-{os.getpid()}"
    outage = OutageLog(f"{role}'s heartbeat")

    def send_heartbeats() -> None:
        while not stop.is_set():
            state = read_state()
            try:
                with catalog.write(is_heartbeat=True) as session:
                    _upsert_process(session, process_id, role, name, state)
                outage.record_success()
            except SQLAlchemyError as error:
                outage.record_error(error)
            next_beat = time.monotonic() + PROCESS_HEARTBEAT_SECONDS
            while time.monotonic() < next_beat and not stop.wait(STATE_POLL_SECONDS):
                if read_state() != state:
                    break

    thread = threading.Thread(target=send_heartbeats, name="heartbeat", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        try:
            with catalog.write() as session:
                session.execute(delete(RegisteredProcess).where(RegisteredProcess.id == process_id))
        except SQLAlchemyError as error:
            log.info("this process could not be unregistered: %s", error)


def _upsert_process(
    session: Session, process_id: UUID, role: str, name: str, state: dict[str, Any] | None
) -> None:
    updated = session.execute(
        update(RegisteredProcess)
        .where(RegisteredProcess.id == process_id)
        .values(seen_at=db_now(), state=state)
        .returning(RegisteredProcess.id)
    )
    if updated.first() is None:
        # Dead processes of the same role are replaced by this one.
        session.execute(
            delete(RegisteredProcess).where(
                or_(
                    RegisteredProcess.seen_at < db_now_plus(-PROCESS_RETENTION_SECONDS),
                    and_(
                        RegisteredProcess.role == role,
                        RegisteredProcess.seen_at < db_now_plus(-PROCESS_TIMEOUT_SECONDS),
                    ),
                )
            )
        )
        session.add(
            RegisteredProcess(
                id=process_id, role=role, name=name, release=version("placewise"), state=state
            )
        )


def delete_processes(session: Session, role: str) -> None:
    """Unregister all processes of a role, where none can be running."""
    session.execute(delete(RegisteredProcess).where(RegisteredProcess.role == role))


def list_processes(session: Session) -> list[ProcessStatus]:
    """List the processes with a heartbeat in the last day.

    A process without a heartbeat for PROCESS_TIMEOUT_SECONDS is dead.
    """
    rows = session.execute(
        select(RegisteredProcess, db_now()).order_by(RegisteredProcess.role, RegisteredProcess.name)
    )
    return [
        ProcessStatus(
            process.role,
            process.name,
            process.release,
            (now - process.seen_at).total_seconds(),
            process.state or {},
        )
        for process, now in rows
    ]


# Several heartbeats: a worker without one for longer is dead and does not block activations.
SEARCH_WORKER_TIMEOUT_SECONDS = 10.0


class RegisteredSearchWorker(Base):
    """A search worker process.

    `loaded` maps generation ids to the map version up to which all chunks are loaded.
    """

    __tablename__ = "search_workers"

    id: Mapped[UUID] = mapped_column(Uuid, primary_key=True, default=new_id)
    name: Mapped[str] = mapped_column(String(200))
    loaded: Mapped[dict[str, Any]] = mapped_column(JsonValue, default=dict)
    seen_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())

    def has(self, generation_id: UUID, version: int) -> bool:
        """Return whether it has loaded the generation at this version or a later one."""
        return int(self.loaded.get(str(generation_id), -1)) >= version


def upsert_search_worker(
    session: Session, worker_id: UUID, name: str, loaded: Mapping[UUID, int]
) -> None:
    """Write a heartbeat of the worker with its loaded versions."""
    versions = {str(id_): version for id_, version in loaded.items()}
    updated = session.execute(
        update(RegisteredSearchWorker)
        .where(RegisteredSearchWorker.id == worker_id)
        .values(loaded=versions, seen_at=db_now())
        .execution_options(synchronize_session=False)
    )
    if not affected_rows(updated):  # new, or removed while it could not reach the catalog
        session.add(RegisteredSearchWorker(id=worker_id, name=name, loaded=versions))


def delete_search_worker(session: Session, worker_id: UUID) -> None:
    """Unregister a worker that shuts down."""
    session.execute(delete(RegisteredSearchWorker).where(RegisteredSearchWorker.id == worker_id))


def delete_dead_search_workers(session: Session, *, all_workers: bool = False) -> int:
    """Unregister dead workers, or all of them where none can be running; return their number."""
    dead = delete(RegisteredSearchWorker)
    if not all_workers:
        dead = dead.where(
            RegisteredSearchWorker.seen_at < db_now_plus(-SEARCH_WORKER_TIMEOUT_SECONDS)
        )
    return affected_rows(session.execute(dead))


def list_lagging_workers(
    session: Session, generation_id: UUID, version: int
) -> list[RegisteredSearchWorker]:
    """List the live workers that have not loaded the generation at `version` yet, by name."""
    live = session.scalars(
        select(RegisteredSearchWorker)
        .where(RegisteredSearchWorker.seen_at >= db_now_plus(-SEARCH_WORKER_TIMEOUT_SECONDS))
        .order_by(RegisteredSearchWorker.name, RegisteredSearchWorker.id)
    )
    return [worker for worker in live if not worker.has(generation_id, version)]
