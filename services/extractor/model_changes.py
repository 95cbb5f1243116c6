"""Model changes: handlers of vocabulary imports and switches, and the start of the new generation.

The vocabulary or whitening of a model change and its generation are stored in one transaction.
"""

from __future__ import annotations

from dataclasses import dataclass
from uuid import UUID

from services.extractor.handlers import ExtractorContext, handles_model_change
from services.extractor.model_registry import DescriptorPipeline, generation_spec_columns
from shared.catalog.database.base import insert_row
from shared.catalog.generations import active_generation
from shared.catalog.maps import Map
from shared.catalog.photos import count_live_photos
from shared.catalog.vocabularies import (
    StoredWhitening,
    Vocabulary,
    VocabularyOrigin,
    get_vocabulary,
)
from shared.descriptors.extractor import Extractor
from shared.descriptors.pca_whitening import PcaWhiteningFile, decode_whitening
from shared.descriptors.vocabulary import encode_centres
from shared.descriptors.vocabulary_file import Provenance, check_vocabulary_fits, decode_vocabulary
from shared.errors import Unprocessable
from shared.jobs import Job, JobKind
from shared.jobs.leases import lock_leased_job
from shared.jobs.model_changes import create_generation
from shared.storage.keys import new_vocabulary_key, new_whitening_key


@handles_model_change(JobKind.IMPORT)
def import_vocabulary(context: ExtractorContext, job: Job) -> None:
    """Switch the map to the vocabulary file at `object_key`.

    Raises:
        Unprocessable: `vocabulary_unusable` if the map's extractor can't use it.
    """
    extractor = map_extractor(context, job)
    imported = decode_vocabulary(context.store.get(job.params["object_key"]))
    check_vocabulary_fits(imported.provenance, imported.centres, extractor)
    provenance = {**imported.provenance, "imported_from": job.params["filename"]}
    start_generation(
        context,
        job,
        DescriptorPipeline(extractor, imported.centres),
        NewVocabulary(VocabularyOrigin.IMPORTED, provenance),
    )


@handles_model_change(JobKind.SWITCH)
def switch_vocabulary(context: ExtractorContext, job: Job) -> None:
    """Switch to the map's vocabulary `vocabulary_id`, or to None for an extractor without one.

    With the parameter `extractor`, also switch to that extractor; None then means the vocabulary
    that it ships with. Without both, a map that pools until it has a vocabulary goes on doing so.
    A reindexed generation keeps the whitening `whitening_id`.

    Raises:
        Unprocessable: `vocabulary_unusable` if the extractor can't use the vocabulary, or if it
            needs one and None was given; `pca_unusable` if the whitening was fitted on other
            descriptors.
    """
    vocabulary_id, shipped = job.params["vocabulary_id"], None
    vocabulary: NewVocabulary | UUID | None = None
    if job.params.get("extractor") is None:
        extractor = map_extractor(context, job, active=vocabulary_id is None)
    else:
        extractor = context.models.extractor(job.params["extractor"])
        shipped = extractor.shipped_vocabulary()
    if vocabulary_id is not None:
        with context.catalog.read() as session:
            stored = get_vocabulary(session, job.map_id, UUID(vocabulary_id))
        centres = context.models.centres(stored)
        check_vocabulary_fits(stored.provenance, centres, extractor)
        vocabulary = stored.id
    elif shipped is not None:
        centres, provenance = shipped
        vocabulary = NewVocabulary(VocabularyOrigin.SHIPPED, provenance)
    elif extractor.config.needs_vocabulary:
        raise Unprocessable(
            "vocabulary_unusable",
            f"The extractor {extractor.config.name} needs a vocabulary. Choose one with "
            "`vocabulary_id`.",
        )
    else:
        centres = None
    projection, whitening_id = None, job.params.get("whitening_id")
    if whitening_id is not None:
        with context.catalog.read() as session:
            whitening = session.get_one(StoredWhitening, UUID(whitening_id))
        file = decode_whitening(context.store.get(whitening.object_key))
        file.check_compatible(extractor.spec(centres))
        projection = context.models.projection(whitening)
    start_generation(
        context,
        job,
        DescriptorPipeline(extractor, centres, projection),
        vocabulary,
        whitening_id and UUID(whitening_id),
    )


def map_extractor(context: ExtractorContext, job: Job, *, active: bool = False) -> Extractor:
    """Return the extractor of the job's map with its weights loaded.

    With `active`, return that of the map's active generation, if there is one: it may pool instead,
    until the map has a vocabulary.
    """
    with context.catalog.read() as session:
        generation = active_generation(session, job.map_id) if active else None
        name = (generation or session.get_one(Map, job.map_id)).extractor
    return context.models.extractor(name)


@dataclass(frozen=True, slots=True)
class NewVocabulary:
    """Where a vocabulary that is not stored yet comes from."""

    origin: VocabularyOrigin
    provenance: Provenance


def start_generation(
    context: ExtractorContext,
    job: Job,
    pipeline: DescriptorPipeline,
    vocabulary: NewVocabulary | UUID | None,
    whitening: PcaWhiteningFile | UUID | None = None,
    *,
    progress_done: int = 0,
) -> None:
    """Create the generation of a model change, under the job's lease, in one transaction.

    Args:
        context: The worker's context.
        job: The claimed model change.
        pipeline: Computes the generation's descriptors.
        vocabulary: The vocabulary of `pipeline.centres`: a new one, which is stored, or the id of a
            stored one; None for an extractor without.
        whitening: That of `pipeline.projection`, in the same way.
        progress_done: Progress of the job before any photo is described.
    """
    centres, projection = pipeline.centres, pipeline.projection
    vocabulary_id = vocabulary if isinstance(vocabulary, UUID) else None
    whitening_id = whitening if isinstance(whitening, UUID) else None
    vocabulary_key, whitening_key = new_vocabulary_key(), new_whitening_key()
    if centres and isinstance(vocabulary, NewVocabulary):
        context.store.put(vocabulary_key, encode_centres(centres))
    if isinstance(whitening, PcaWhiteningFile):
        context.store.put(whitening_key, whitening.encode())
    with context.catalog.write() as session:
        leased = lock_leased_job(session, job)
        if leased is None:
            return
        params = {**leased.params, "done_before": progress_done}
        if centres and isinstance(vocabulary, NewVocabulary):
            stored_vocabulary = Vocabulary(
                map_id=job.map_id,
                origin=vocabulary.origin,
                clusters=centres.clusters,
                dimension=centres.dimension,
                object_key=vocabulary_key,
                sha256=centres.sha256,
                provenance=vocabulary.provenance,
            )
            vocabulary_id = insert_row(session, stored_vocabulary).id
            params["vocabulary_id"] = str(vocabulary_id)
        if projection and isinstance(whitening, PcaWhiteningFile):
            fitted = whitening.whitening
            stored_whitening = StoredWhitening(
                map_id=job.map_id,
                dimension=fitted.dimension,
                components=fitted.components,
                rows=fitted.rows,
                explained=fitted.explained,
                object_key=whitening_key,
                sha256=projection.sha256,
            )
            whitening_id = insert_row(session, stored_whitening).id
            params["whitening_id"] = str(whitening_id)
        columns = generation_spec_columns(session, pipeline, vocabulary_id, whitening_id)
        create_generation(session, leased, **columns)
        leased.params = params
        leased.attempts = 0
        leased.progress_done = progress_done
        leased.progress_total = progress_done + count_live_photos(session, job.map_id)
