"""Every table, imported: what Alembic compares the database with."""

from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.direct_uploads import PresignedUpload
from shared.catalog.evaluations import Evaluation
from shared.catalog.figures import CachedMapStatistics
from shared.catalog.generations import Generation
from shared.catalog.idempotency import IdempotencyRecord
from shared.catalog.installation import Installation
from shared.catalog.keys import ApiKey
from shared.catalog.live_processes import RegisteredProcess
from shared.catalog.maps import Map
from shared.catalog.models import Model
from shared.catalog.photos import Photo
from shared.catalog.schema_compatibility import SchemaCompatibility
from shared.catalog.search_workers import RegisteredSearchWorker
from shared.catalog.searches import Search
from shared.catalog.vocabularies import Vocabulary
from shared.catalog.webhooks import Delivery, Webhook
from shared.catalog.whitenings import StoredWhitening
from shared.jobs.batches import BatchItem
from shared.jobs.table import Job

__all__ = [
    "ApiKey",
    "BatchItem",
    "Chunk",
    "Delivery",
    "Descriptor",
    "PresignedUpload",
    "Evaluation",
    "Generation",
    "Installation",
    "Job",
    "IdempotencyRecord",
    "RegisteredProcess",
    "Map",
    "CachedMapStatistics",
    "Model",
    "Photo",
    "RegisteredSearchWorker",
    "SchemaCompatibility",
    "Search",
    "StoredWhitening",
    "Vocabulary",
    "Webhook",
]
