"""After an upgrade: maps whose descriptors this worker would make otherwise are described anew.

Another release of the decoder changes pixels, and with them descriptors, a little. Rows of two
specs never mix, so uploads would wait. Where this is the only worker, it starts the model change
itself; among several, a person decides when all of them have been upgraded.
"""

from __future__ import annotations

import logging

from sqlalchemy import select

from services.extractor.loaded import ModelRegistry
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.maps import Map
from shared.catalog.session import Catalog
from shared.catalog.vocabularies import Vocabulary
from shared.catalog.whitenings import StoredWhitening
from shared.errors import Conflict, PlacewiseError
from shared.jobs import JobKind
from shared.jobs.model_changes import start_model_change
from shared.vision.extractors import spec_fingerprint

log = logging.getLogger(__name__)


def reindex_outdated_generations(catalog: Catalog, models: ModelRegistry) -> int:
    """Start a switch to the same vocabulary and whitening in every outdated map; how many."""
    with catalog.read() as session:
        found = session.execute(
            select(Generation, Vocabulary, StoredWhitening)
            .outerjoin(Vocabulary, Vocabulary.id == Generation.vocabulary_id)
            .outerjoin(StoredWhitening, StoredWhitening.id == Generation.whitening_id)
            .join(Map, Map.id == Generation.map_id)
            .where(Generation.state == GenerationState.ACTIVE, Map.deleted_at.is_(None))
        ).all()
    started = 0
    for generation, vocabulary, whitening in found:
        try:
            made = models.pipeline_of_generation(generation, vocabulary, whitening)
        except PlacewiseError as error:
            log.error("generation %s can't be checked: %s", generation.id, error.detail)
            continue
        if spec_fingerprint(made.spec) == generation.spec_fingerprint:
            continue
        params = {
            "vocabulary_id": str(vocabulary.id) if vocabulary else None,
            "whitening_id": str(whitening.id) if whitening else None,
        }
        try:
            with catalog.write() as session:
                start_model_change(session, generation.map_id, JobKind.SWITCH, params)
        except Conflict:
            continue  # a model change is under way, and brings the new spec
        log.warning("generation %s was made by other releases: describing anew", generation.id)
        started += 1
    return started
