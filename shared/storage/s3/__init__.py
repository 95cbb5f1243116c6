"""Objects in a bucket of any S3 server, through the minio client.

`bucket` connects and turns every failure into one of Placewise's errors; `writer` and `reader`
stream; `store` is the port; `create` makes the bucket once.
"""

from shared.storage.s3.bucket import Bucket, create_bucket
from shared.storage.s3.store import S3Store

__all__ = ["Bucket", "S3Store", "create_bucket"]
