"""Making the bucket, once, by whoever sets a deployment up."""

from __future__ import annotations

import logging

from minio.commonconfig import ENABLED, Filter
from minio.error import S3Error
from minio.lifecycleconfig import AbortIncompleteMultipartUpload, LifecycleConfig, Rule

from shared.objects.s3.bucket import Bucket

log = logging.getLogger(__name__)

ALREADY_OWNED_CODE = "BucketAlreadyOwnedByYou"
LIFECYCLE_UNSUPPORTED_CODES = {"NotImplemented", "MethodNotAllowed"}
ABORT_UPLOADS_AFTER_DAYS = 1  # S3's least

# The parts that killed writers leave can't be seen, and cost room.
LIFECYCLE_RULES = LifecycleConfig(
    [
        Rule(
            ENABLED,
            rule_id="placewise-unfinished-uploads",
            rule_filter=Filter(prefix=""),
            abort_incomplete_multipart_upload=AbortIncompleteMultipartUpload(
                days_after_initiation=ABORT_UPLOADS_AFTER_DAYS
            ),
        )
    ]
)


def create_bucket(bucket: Bucket) -> bool:
    """Make the bucket, and give it the rule for unfinished uploads unless it has rules already.

    True if it was made, False if it was there. Raises Unavailable as `Bucket.explained` says.
    """
    client = bucket.client
    with bucket.explained():
        made = not client.bucket_exists(bucket.name)
        if made:
            try:
                client.make_bucket(bucket.name)
            except S3Error as error:
                if error.code != ALREADY_OWNED_CODE:
                    raise
                made = False  # by another one, since we looked
        try:
            if client.get_bucket_lifecycle(bucket.name) is None:
                client.set_bucket_lifecycle(bucket.name, LIFECYCLE_RULES)
        except S3Error as error:
            if error.code not in LIFECYCLE_UNSUPPORTED_CODES:
                raise
            log.warning(
                "the object store at %s knows no lifecycle rules: what killed processes have sent "
                "of an object stays in the bucket %s until someone removes it",
                bucket.endpoint,
                bucket.name,
            )
    return made
