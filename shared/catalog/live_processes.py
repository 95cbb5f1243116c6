"""Which processes of a deployment live: gateways, extractors, stewards. (Search workers have a
register of their own, which says what they have loaded.)

Nothing is decided by it, leases decide: it is for `placewise doctor` and for people.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from importlib.metadata import version
from uuid import UUID

from sqlalchemy import String, Uuid, delete, select, update
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.away import OutageLog
from shared.catalog.base import Base, UtcDateTime, db_now, db_now_plus
from shared.catalog.session import Catalog
from shared.ids import new_id

log = logging.getLogger(__name__)

PROCESS_HEARTBEAT_SECONDS = 10.0
PROCESS_TIMEOUT_SECONDS = 35.0  # three of them, and a little
PROCESS_RETENTION_SECONDS = 86_400.0


class RegisteredProcess(Base):
    """One process; `role` is the name of its command."""

    __tablename__ = "live_processes"

    id: Mapped[UUID] = mapped_column(Uuid, primary_key=True, default=new_id)
    role: Mapped[str] = mapped_column(String(20))
    name: Mapped[str] = mapped_column(String(200))
    release: Mapped[str] = mapped_column(String(30))
    started_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    seen_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())


@dataclass(frozen=True, slots=True)
class ProcessStatus:
    role: str
    name: str
    release: str
    seconds_since_heartbeat: float


@contextlib.contextmanager
def process_heartbeat(catalog: Catalog, role: str) -> Iterator[None]:
    """While the block runs, a thread says every EVERY_SECONDS that this process lives. While the
    catalog is away it says nothing, and is the first to notice that nobody listens."""
    process_id, stop = new_id(), threading.Event()
    name = f"{socket.gethostname()}-{os.getpid()}"
    outage = OutageLog(f"{role}'s sign of life")

    def tell() -> None:
        while True:
            try:
                with catalog.write() as session:
                    _upsert_process(session, process_id, role, name)
                outage.record_success()
            except SQLAlchemyError as error:
                outage.record_error(error)
            if stop.wait(PROCESS_HEARTBEAT_SECONDS):
                return

    teller = threading.Thread(target=tell, name="signs-of-life", daemon=True)
    teller.start()
    try:
        yield
    finally:
        stop.set()
        teller.join()
        try:
            with catalog.write() as session:
                session.execute(delete(RegisteredProcess).where(RegisteredProcess.id == process_id))
        except SQLAlchemyError as error:
            log.info("this process could not sign off: %s", error)


def _upsert_process(session: Session, process_id: UUID, role: str, name: str) -> None:
    touched = session.execute(
        update(RegisteredProcess)
        .where(RegisteredProcess.id == process_id)
        .values(seen_at=db_now())
        .returning(RegisteredProcess.id)
    )
    if touched.first() is None:
        session.execute(
            delete(RegisteredProcess).where(
                RegisteredProcess.seen_at < db_now_plus(-PROCESS_RETENTION_SECONDS)
            )
        )
        session.add(
            RegisteredProcess(id=process_id, role=role, name=name, release=version("placewise"))
        )


def list_processes(session: Session) -> list[ProcessStatus]:
    """Every process that was heard of in the last day; who is silent for DEAD_SECONDS is dead, or
    was killed."""
    found = session.execute(
        select(RegisteredProcess, db_now()).order_by(RegisteredProcess.role, RegisteredProcess.name)
    )
    return [
        ProcessStatus(one.role, one.name, one.release, (now - one.seen_at).total_seconds())
        for one, now in found
    ]
