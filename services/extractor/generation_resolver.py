"""Resolution of the generation that a batch is described into, and reindexing after an upgrade.

`resolve_generation` returns a job's generation with its extractor, vocabulary and projection, and
creates a map's first generation.

Another release of the decoder changes pixels slightly, and descriptors with them. Rows of two specs
are never mixed, so uploads would wait. A worker that is the only one starts the model change itself
(`reindex_outdated_generations`); where there are several, an operator starts it once all of them
are upgraded.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from uuid import UUID

from sqlalchemy import select

from services.extractor.handlers import ExtractorContext
from services.extractor.model_registry import (
    DescriptorPipeline,
    ModelRegistry,
    check_spec_matches,
    generation_spec_columns,
)
from shared.catalog.database.base import db_now, insert_row
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState, active_generation
from shared.catalog.maps import Map, Matching, increment_map_version, lock_map
from shared.catalog.vocabularies import Vocabulary, VocabularyOrigin
from shared.descriptors.extractor import Extractor, spec_fingerprint
from shared.descriptors.vocabulary import encode_centres
from shared.errors import Conflict, PlacewiseError
from shared.extractor_config.configs import pooled_config
from shared.jobs import Job, JobKind
from shared.jobs.model_changes import start_reindex
from shared.storage.keys import new_vocabulary_key

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class ResolvedGeneration(DescriptorPipeline):
    """A generation with the pipeline that computes its descriptors."""

    generation: Generation
    matching: Matching  # of the map


def resolve_generation(context: ExtractorContext, job: Job) -> ResolvedGeneration:
    """Return the generation for the batch of `job`.

    A job that names a generation gets that one; other jobs get the map's active one, which is
    created on first use: with GeM pooling if the extractor needs a vocabulary and ships none.

    Raises:
        Unavailable: `spec_differs` if this worker can't reproduce the generation's spec.
    """
    with context.catalog.read() as session:
        if job.generation_id is not None:
            generation = session.get(Generation, job.generation_id)
        else:
            generation = active_generation(session, job.map_id)
        map_ = session.get_one(Map, job.map_id)
    if generation is None:
        extractor = context.models.extractor(map_.extractor)
        generation = _create_first_generation(context, extractor, job.map_id)
    pipeline = context.models.pipeline_of_generation(context.catalog, generation)
    target = ResolvedGeneration(
        pipeline.extractor,
        pipeline.centres,
        pipeline.projection,
        generation=generation,
        matching=Matching(map_.matching),
    )
    # A query's descriptor is not stored: another decoder release is close enough.
    check_spec_matches(generation, target, decoder_matters=job.kind != JobKind.DESCRIBE)
    return target


def _create_first_generation(
    context: ExtractorContext, extractor: Extractor, map_id: UUID
) -> Generation:
    """Create the map's first generation, with the shipped vocabulary if one is needed.

    If none is shipped, the generation's extractor pools the same local features, while the map
    keeps its own, with which the vocabulary is fitted later.

    Returns the existing generation if another worker has created it meanwhile.
    """
    shipped = extractor.shipped_vocabulary()
    if extractor.config.needs_vocabulary and shipped is None:
        extractor = context.models.extractor(pooled_config(extractor.config).name)
    key = new_vocabulary_key()
    if shipped is not None:
        context.store.put(key, encode_centres(shipped[0]))
    with context.catalog.write() as session:
        map_ = lock_map(session, map_id)
        existing = active_generation(session, map_id)
        if existing is not None:  # another worker has created it
            return existing
        vocabulary_id, centres = None, None
        if shipped is not None:
            centres, provenance = shipped
            vocabulary = Vocabulary(
                map_id=map_id,
                origin=VocabularyOrigin.SHIPPED,
                clusters=centres.clusters,
                dimension=centres.dimension,
                object_key=key,
                sha256=centres.sha256,
                provenance=provenance,
            )
            vocabulary_id = insert_row(session, vocabulary).id
        generation = Generation(
            map_id=map_id,
            state=GenerationState.ACTIVE,
            activated_at=db_now(),
            row_type=map_.row_type,
            **generation_spec_columns(
                session, DescriptorPipeline(extractor, centres), vocabulary_id
            ),
        )
        insert_row(session, generation)
        increment_map_version(session, map_id)
    log.info("generation %s created with extractor %s", generation.id, extractor.config.name)
    return generation


def reindex_outdated_generations(catalog: Catalog, models: ModelRegistry) -> int:
    """Start a reindex, with the same vocabulary and whitening, of every map with an outdated spec.

    Returns:
        The number of model changes started.
    """
    with catalog.read() as session:
        active = session.scalars(
            select(Generation)
            .join(Map, Map.id == Generation.map_id)
            .where(Generation.state == GenerationState.ACTIVE, Map.deleted_at.is_(None))
        ).all()
    started = 0
    for generation in active:
        try:
            pipeline = models.pipeline_of_generation(catalog, generation)
        except PlacewiseError as error:
            log.error("generation %s can't be checked: %s", generation.id, error.detail)
            continue
        if spec_fingerprint(pipeline.spec) == generation.spec_fingerprint:
            continue
        try:
            with catalog.write() as session:
                start_reindex(session, generation)
        except Conflict:
            continue  # a model change is running and will use the new spec
        log.warning("generation %s has an outdated spec: reindexing its map", generation.id)
        started += 1
    return started
