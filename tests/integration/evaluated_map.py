"""A map laid out by hand: each photo's descriptor is a direction in the plane.

The cosine of two photos is that of the angle between them, so that every ranking, and with it
every figure of an evaluation, can be computed with a pencil.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any
from uuid import UUID

import numpy as np
from sqlalchemy import select

from services.search.worker import SearchWorker
from services.steward.evaluation_worker import EvaluationWorker
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Evaluation, Generation
from shared.catalog.maps import DEFAULT_MAP
from shared.config.settings import Settings
from shared.ids import new_id
from shared.jobs import Job, JobKind, Priority
from shared.search_api.protocol import (
    MatchRequest,
    MatchResponse,
    PoseRequest,
    PoseResponse,
    SearchBackend,
    SearchRequest,
    SearchResponse,
    SearchStatus,
)
from shared.storage import FolderStore
from tests.support.catalog_rows import (
    add_chunk,
    add_generation,
    add_map,
    add_photo,
    read_job,
    result_of,
)

Seen = tuple[float, dict[str, Any]]
"""A photo: its angle in degrees, and what is known of it (columns of `Photo`)."""


class EvaluatedMap:
    """Photos at angles, published as an extractor does it, and an evaluator to ask them."""

    def __init__(self, catalog: Catalog, store: FolderStore, name: str = DEFAULT_MAP) -> None:
        self.catalog, self.store = catalog, store
        with catalog.write() as session:
            self.map_id = add_map(session, name).id
            self.generation_id = add_generation(session, self.map_id, dimension=2).id
        self.search = SearchWorker(catalog, store, Settings())

    def publish(self, photos: Sequence[Seen], generation_id: UUID | None = None) -> list[UUID]:
        """A chunk of described photos; their ids."""
        into = generation_id or self.generation_id
        angles = np.radians([angle for angle, _ in photos])
        rows = np.column_stack([np.cos(angles), np.sin(angles)]).astype(np.float32)
        with self.catalog.write() as session:
            photo_ids = [add_photo(session, self.map_id, **columns).id for _, columns in photos]
        add_chunk(self.catalog, self.store, into, photo_ids, rows=rows)
        return photo_ids

    def start(self, **params: Any) -> UUID:
        """Queue an evaluation, as `POST /evaluations` does it; its job."""
        with self.catalog.write() as session:
            job = Job(
                id=new_id(),
                map_id=self.map_id,
                kind=JobKind.EVALUATE,
                priority=Priority.EVALUATION,
                params={"sample": 1000, "seed": 0, "automatic": False, **params},
            )
            session.add(job)
        return job.id

    def evaluator(self, search: SearchBackend | None = None) -> EvaluationWorker:
        search = search or self.search
        return EvaluationWorker(self.catalog, self.store, search, Settings(), "evaluator")

    def work(
        self, search: SearchBackend | None = None, stop: threading.Event | None = None
    ) -> bool:
        """Do the next evaluation; False when there was none."""
        return self.evaluator(search).run_next(stop or threading.Event())

    def figures(self, **params: Any) -> dict[str, Any]:
        """What an evaluation of now comes to."""
        job_id = self.start(**params)
        assert self.work()
        return result_of(read_job(self.catalog, job_id))

    def evaluations(self) -> list[Evaluation]:
        """All of the map, oldest first."""
        with self.catalog.read() as session:
            return list(
                session.scalars(
                    select(Evaluation)
                    .where(Evaluation.map_id == self.map_id)
                    .order_by(Evaluation.id)
                )
            )

    def evaluation_jobs(self) -> list[Job]:
        with self.catalog.read() as session:
            return list(
                session.scalars(
                    select(Job)
                    .where(Job.map_id == self.map_id, Job.kind == JobKind.EVALUATE)
                    .order_by(Job.id)
                )
            )

    def calibration(self) -> dict[str, Any] | None:
        with self.catalog.read() as session:
            return session.get_one(Generation, self.generation_id).calibration


@dataclass(slots=True)
class Watched:
    """A search port that notes its searches, and has something done before the n-th (from 1)."""

    port: SearchBackend
    at: int | None = None
    do: Callable[[], object] = lambda: None
    searches: list[SearchRequest] = field(default_factory=list)

    def search(self, request: SearchRequest) -> SearchResponse:
        self.searches.append(request)
        if len(self.searches) == self.at:
            self.do()
        return self.port.search(request)

    def match(self, request: MatchRequest) -> MatchResponse:
        return self.port.match(request)

    def estimate_pose(self, request: PoseRequest) -> PoseResponse:
        return self.port.estimate_pose(request)

    def status(self) -> SearchStatus:
        return self.port.status()


def metres_north(metres: float) -> float:
    """As degrees of latitude."""
    return math.degrees(metres / 6_371_008.8)
