"""Registry of the extractor's job handlers, which `worker` runs stage by stage.

A handler is a generator that reads from top to bottom: prepare, describe, publish. Each `yield`
ends a stage, and the next one runs in another thread.
"""

from __future__ import annotations

import contextlib
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from services.extractor.decoder_pool import DecoderPool
from services.extractor.model_registry import ModelRegistry
from shared.catalog.database.session import Catalog
from shared.catalog.jobs import Job, JobKind
from shared.config.settings import Settings
from shared.jobs.runner import ClaimedJobs
from shared.storage import ObjectStore


@dataclass(frozen=True, slots=True)
class ExtractorContext:
    """What the handlers of one worker share."""

    catalog: Catalog
    store: ObjectStore
    settings: Settings
    models: ModelRegistry
    decoders: DecoderPool
    is_stopping: Callable[[], bool]
    """Whether the worker is to stop, so that a pass of a network of others is ended."""


@dataclass(slots=True)
class JobBatch(ClaimedJobs):
    """Claimed jobs of one kind, map and generation, and what has become of them."""

    stages: Iterator[None] = field(default_factory=lambda: iter(()))
    """The running handler."""
    outcomes: Counter[str] = field(default_factory=Counter)
    """Number of jobs that succeeded, failed or were lost (taken over or cancelled)."""
    seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    """Duration of each step."""

    @contextlib.contextmanager
    def timed(self, step: str) -> Iterator[None]:
        """Add the duration of the block to those of the step."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[step] += time.perf_counter() - started


Handler = Callable[[ExtractorContext, JobBatch], Iterator[None]]

HANDLERS: dict[JobKind, Handler] = {}


def handles(*kinds: JobKind) -> Callable[[Handler], Handler]:
    """Register the function as the handler of these kinds."""

    def register(handler: Handler) -> Handler:
        HANDLERS.update(dict.fromkeys(kinds, handler))
        return handler

    return register


ModelChange = Callable[[ExtractorContext, Job], None]


def handles_model_change(kind: JobKind) -> Callable[[ModelChange], ModelChange]:
    """Register the function as the handler of one job at a time, which has one stage."""

    def register(change_model: ModelChange) -> ModelChange:
        def handler(context: ExtractorContext, batch: JobBatch) -> Iterator[None]:
            yield
            with batch.timed("model_change"):
                change_model(context, batch.jobs[0])

        handles(kind)(handler)
        return change_model

    return register
