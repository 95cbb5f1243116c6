"""Registry and heartbeats of running processes.

That of gateways, extractors and stewards is informational, for `GET /health` and operators; leases
decide which worker owns a job. Search workers register the versions that they have loaded: a
generation is activated only once every live worker has loaded it.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime
from importlib.metadata import version
from typing import Any
from uuid import UUID

from sqlalchemy import String, and_, delete, or_, select, update
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.database.base import Entity, JsonValue, UtcDateTime, db_now, db_now_plus
from shared.catalog.database.errors import OutageLog
from shared.catalog.database.session import Catalog
from shared.ids import new_id

log = logging.getLogger(__name__)

PROCESS_HEARTBEAT_SECONDS = 10.0
STATE_POLL_SECONDS = 0.5
PROCESS_TIMEOUT_SECONDS = 35.0  # three missed heartbeats
PROCESS_RETENTION_SECONDS = 86_400.0


class RegisteredProcess(Entity):
    """A running process; `role` is the name of its command, `state` what it reports of itself."""

    __tablename__ = "live_processes"

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
        registered = None
        while not stop.is_set():
            state = read_state()
            try:
                with catalog.write(is_heartbeat=state == registered) as session:
                    upsert_process(session, process_id, role, name, state)
                registered = state
                outage.record_success()
            except SQLAlchemyError as error:
                outage.record_error(error)
            next_beat = time.monotonic() + PROCESS_HEARTBEAT_SECONDS
            while time.monotonic() < next_beat and not stop.wait(STATE_POLL_SECONDS):
                if read_state() != registered:
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


def upsert_process(
    session: Session, process_id: UUID, role: str, name: str, state: dict[str, Any] | None
) -> None:
    """Write a heartbeat of the process."""
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


def delete_processes(session: Session) -> None:
    """Unregister all processes, where none can be running."""
    session.execute(delete(RegisteredProcess))


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


def list_lagging_search_workers(session: Session, generation_id: UUID, version: int) -> list[str]:
    """Return the names of the live search workers that have not loaded the generation at `version`.

    Their state has the map version up to which all chunks are loaded, by generation.
    """
    return [
        process.name
        for process in list_processes(session)
        if process.role == "search"
        and process.is_live
        and process.state["loaded"].get(str(generation_id), -1) < version
    ]
