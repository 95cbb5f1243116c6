"""Extractors that share one pool of decoder processes: starting one takes a second."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any
from uuid import UUID

import pytest

from services.extractor import fits
from services.extractor.added_models import AddedModelLoader
from services.extractor.decoder_pool import DecoderPool
from services.extractor.fits import FitRequest, Fitted, Report
from services.extractor.model_registry import ModelRegistry
from services.extractor.worker import ExtractorWorker
from services.steward.tasks import auto_fit, reindex_jobs
from shared.catalog import vocabularies
from shared.catalog.database.session import Catalog
from shared.catalog.maps import get_or_create_default_map
from shared.config.settings import Settings
from shared.storage import FolderStore
from tests.integration.api_with_keys import Door
from tests.integration.harness import Harness
from tests.integration.in_process_api import Service
from tests.support.catalog_rows import add_map

BATCH_PHOTOS = 4


class LentDecoders:
    """The shared pool, which a closing worker leaves alone."""

    def __init__(self, pool: DecoderPool) -> None:
        self._pool = pool

    def decode(self, *photos: Any, **options: Any) -> Any:
        return self._pool.decode(*photos, **options)

    def close(self) -> None:
        pass


@pytest.fixture(scope="session")
def decoders() -> Iterator[DecoderPool]:
    pool = DecoderPool(Settings.model_construct(decode_processes=1))
    yield pool
    pool.close()


@pytest.fixture
def make_worker(
    catalog: Catalog,
    store: FolderStore,
    settings: Settings,
    decoders: DecoderPool,
) -> Iterator[Callable[..., ExtractorWorker]]:
    """Makes extractors, which are closed in the end; keywords change their settings.

    They fit in this process: starting another one takes seconds.
    """
    lent: Any = LentDecoders(decoders)
    small = settings.model_copy(update={"batch_photos": BATCH_PHOTOS, "device": "cpu"})
    made: list[ExtractorWorker] = []
    load_added = AddedModelLoader(catalog, store, small).load

    def fit_here(request: FitRequest, own: Settings, report: Report, _check: Any) -> Fitted:
        models = ModelRegistry(store, own, load_added)
        return fits.compute_fit(request, store, models, lent, own.batch_photos, report)

    def make(**changes: object) -> ExtractorWorker:
        own = small.model_copy(update=changes)
        name = f"worker-{len(made)}"
        made.append(ExtractorWorker(catalog, store, own, name, decoders=lent, compute_fit=fit_here))
        return made[-1]

    yield make
    for worker in made:
        worker.close()


@pytest.fixture
def service(
    catalog: Catalog,
    store: FolderStore,
    settings: Settings,
    make_worker: Callable[[], ExtractorWorker],
) -> Service:
    """The HTTP API on an empty catalog with the map `default`."""
    with catalog.write() as session:
        get_or_create_default_map(session, settings.extractor)
    return Service(catalog, store, settings, make_worker)


@pytest.fixture
def door(catalog: Catalog, store: FolderStore, settings: Settings) -> Door:
    """The HTTP API behind keys, on an empty catalog with the map `default`."""
    return Door(catalog, store, settings)


@pytest.fixture
def harness_of(
    catalog: Catalog,
    store: FolderStore,
    settings: Settings,
    make_worker: Callable[[], ExtractorWorker],
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[[str], Harness]:
    """Makes a map with the extractor of that name; each call another map."""
    # One call of `advance` queues all photos, however slow the machine is.
    monkeypatch.setattr(reindex_jobs, "SLICE_SECONDS", 60.0)

    def make(extractor: str) -> Harness:
        name = f"map-{UUID(int=len(made))}"
        with catalog.write() as session:
            map_id = add_map(session, name, extractor).id
        made.append(map_id)
        return Harness(catalog, store, settings, map_id, make_worker)

    made: list[UUID] = []
    return make


@pytest.fixture
def fit_at_four_photos(monkeypatch: pytest.MonkeyPatch) -> None:
    """Vocabularies are fitted automatically at four photos, however lately the last one arrived."""
    monkeypatch.setattr(vocabularies, "MIN_PHOTOS_TO_FIT", 4)
    monkeypatch.setattr(auto_fit, "QUIET_SECONDS", -1.0)


@pytest.fixture
def averages(harness_of: Callable[[str], Harness]) -> Harness:
    """A map whose extractor needs no vocabulary."""
    return harness_of("test-tiny-avg")


@pytest.fixture
def vlads(harness_of: Callable[[str], Harness]) -> Harness:
    """A map whose extractor needs a vocabulary, and none comes with it."""
    return harness_of("test-tiny-vlad")
