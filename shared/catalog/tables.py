"""Every table, imported: what Alembic compares the database with."""

from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.evaluations import Evaluation
from shared.catalog.generations import Generation
from shared.catalog.installation import Installation
from shared.catalog.maps import Map
from shared.catalog.models import Model
from shared.catalog.photos import Photo
from shared.catalog.search_workers import RegisteredWorker
from shared.catalog.searches import Search
from shared.catalog.vocabularies import Vocabulary
from shared.jobs.table import Job

__all__ = [
    "Chunk",
    "Descriptor",
    "Evaluation",
    "Generation",
    "Installation",
    "Job",
    "Map",
    "Model",
    "Photo",
    "RegisteredWorker",
    "Search",
    "Vocabulary",
]
