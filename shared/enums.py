"""Enumerations of the catalog that responses contain, for clients of the API too."""

from enum import StrEnum


class PhotoRole(StrEnum):
    DATABASE = "database"  # indexed and searchable
    QUERY = "query"  # a labelled query for evaluations: described, but never a search result


class JobState(StrEnum):
    QUEUED = "queued"  # waits for a worker, or for what `waiting_for` names
    RUNNING = "running"  # a worker has its lease, or it pauses between two slices
    SUCCEEDED = "succeeded"  # completed: its effect is visible
    FAILED = "failed"  # ended with `error`; may be retried
    CANCELLED = "cancelled"  # ended on request; may be retried


class GenerationState(StrEnum):
    BUILDING = "building"  # photos are being described into it; not searched yet
    ACTIVE = "active"  # serves the map's searches
    RETIRED = "retired"  # was active until another was activated; deleted after a grace period
    ABANDONED = "abandoned"  # never became complete; deleted after a grace period


class RowType(StrEnum):
    """NumPy type of stored descriptor rows."""

    FLOAT32 = "float32"
    FLOAT16 = "float16"  # half of the storage, merges and backups


class VocabularyOrigin(StrEnum):
    SHIPPED = "shipped"  # shipped with the extractor: fitted on photos of other places
    FITTED = "fitted"  # fitted on the map's own photos
    IMPORTED = "imported"  # uploaded by the user


class Matching(StrEnum):
    """Whether local features of a map's photos are computed and matched."""

    AUTO = "auto"  # until an evaluation has shown that they do not improve the answers
    ON = "on"
    OFF = "off"


class Scope(StrEnum):
    """Permissions of a key. `write` does not imply `read`: a camera only writes."""

    READ = "read"  # read photos, jobs and statistics; query by photo
    WRITE = "write"  # upload, change and delete photos; fit, evaluate, create maps
    ADMIN = "admin"  # everything, including keys and webhooks
