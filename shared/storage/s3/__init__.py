"""Object store in a bucket of any S3 server, through the minio client.

`bucket` connects and translates the client's errors, `streams` reads and writes objects as streams,
`store` implements the interface of object stores.
"""

from shared.storage.s3.bucket import Bucket, create_bucket
from shared.storage.s3.store import S3Store

__all__ = ["Bucket", "S3Store", "create_bucket"]
