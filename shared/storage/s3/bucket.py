"""A bucket, the client that reaches it, and what its failures mean.

Making the bucket, once, by whoever sets a deployment up.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Self
from xml.etree.ElementTree import ParseError

import urllib3
from minio.commonconfig import ENABLED, Filter
from minio.error import MinioException, S3Error
from minio.helpers import BaseURL
from minio.lifecycleconfig import AbortIncompleteMultipartUpload, LifecycleConfig, Rule
from urllib3.connectionpool import ConnectionPool
from urllib3.exceptions import (
    ConnectTimeoutError,
    HTTPError,
    MaxRetryError,
    ProtocolError,
    ReadTimeoutError,
    SSLError,
)
from urllib3.response import BaseHTTPResponse

from shared.config.settings import Settings
from shared.errors import Misconfigured, NotFound, PlacewiseError, StorageFull, Unavailable
from shared.storage.s3.client import Connections, S3Client

log = logging.getLogger(__name__)

MAX_CONNECTIONS = 32  # kept open: the threads that use the store at once in one process
RETRY_SECONDS = 0.2

NO_SUCH_KEY_CODES = {"NoSuchKey"}
NO_SUCH_BUCKET_CODES = {"NoSuchBucket"}
BAD_CREDENTIALS_CODES = {
    "InvalidAccessKeyId",
    "SignatureDoesNotMatch",
    "ExpiredToken",
    "InvalidToken",
}
ACCESS_DENIED_CODES = {"AccessDenied", "AllAccessDisabled", "AccountProblem", "MethodNotAllowed"}
WRONG_REGION_CODES = {"AuthorizationHeaderMalformed", "PermanentRedirect", "Redirect"}
CLOCK_SKEW_CODES = {"RequestTimeTooSkewed"}
PRECONDITION_FAILED_CODES = {"PreconditionFailed"}
SLOW_DOWN_CODES = {
    "SlowDown",
    "ServiceUnavailable",
    "Throttling",
    "ThrottlingException",
    "RequestTimeout",
}
STORAGE_FULL_CODES = {
    "InsufficientStorage",
    "QuotaExceeded",
    "XMinioStorageFull",
    "XMinioAdminBucketQuotaExceeded",
}
INSUFFICIENT_STORAGE_STATUS = 507
BUSY_RETRY_SECONDS = 5
FULL_RETRY_SECONDS = 60


class RetryUnlessTimeout(urllib3.Retry):
    """Tries again what was cut off or not accepted, but never what was left without an answer.

    A store that is silent was waited for already: a second wait would double the time limit.
    """

    def increment(
        self,
        method: str | None = None,
        url: str | None = None,
        response: BaseHTTPResponse | None = None,
        error: Exception | None = None,
        _pool: ConnectionPool | None = None,
        _stacktrace: TracebackType | None = None,
    ) -> Self:
        if error is not None and _is_timeout(error):
            raise error
        return super().increment(method, url, response, error, _pool, _stacktrace)


@dataclass(frozen=True, slots=True)
class Bucket:
    """One bucket on one server. The client in it may be used by many threads."""

    client: S3Client
    name: str
    endpoint: str
    region: str
    public: BaseURL
    """The server as callers reach it."""

    @classmethod
    def from_settings(cls, settings: Settings) -> Bucket:
        """The bucket that the settings name; nothing is asked of the server yet.

        Raises Misconfigured (`bad_setting`) when S3_ENDPOINT or its keys are not set.
        """
        if not (settings.s3_endpoint and settings.s3_access_key and settings.s3_secret_key):
            raise Misconfigured(
                "bad_setting",
                "S3 needs S3_ENDPOINT (host:port), S3_ACCESS_KEY and S3_SECRET_KEY.",
            )
        # One limit for both: urllib3 sends a request's body under the connection's.
        seconds = settings.s3_timeout_seconds
        connections = Connections(
            num_pools=2,
            maxsize=MAX_CONNECTIONS,
            timeout=urllib3.Timeout(connect=seconds, read=seconds),
            retries=RetryUnlessTimeout(
                total=1,
                backoff_factor=RETRY_SECONDS,
                status_forcelist=(500, 502, 503, 504),
                raise_on_status=False,
                respect_retry_after_header=False,  # it may say minutes
            ),
            cert_reqs="CERT_REQUIRED",  # against the system's authorities, or SSL_CERT_FILE
        )
        client = S3Client(
            settings.s3_endpoint,
            settings.s3_access_key,
            settings.s3_secret_key.get_secret_value(),
            secure=settings.s3_secure,
            region=settings.s3_region,  # left out, the client asks the server for it first
            http_client=connections,
        )
        public = settings.s3_public_endpoint or (
            f"{'https' if settings.s3_secure else 'http'}://{settings.s3_endpoint}"
        )
        return cls(
            client,
            settings.s3_bucket,
            settings.s3_endpoint,
            settings.s3_region,
            BaseURL(public, settings.s3_region),
        )

    @contextlib.contextmanager
    def explained(self, key: str | None = None) -> Iterator[None]:
        """Turns whatever the client raises inside into NotFound (`object_not_found`, only with a
        `key`) or Unavailable (`object_store_unavailable`, `object_store_busy`,
        `object_store_refused`, `bucket_not_found`, `object_changed`, and StorageFull:
        `object_store_full`).

        Keys and buckets can be put right while jobs wait, so a wrong one is Unavailable as well:
        a job that meets it is tried again and not failed for good.
        """
        try:
            yield
        except S3Error as error:
            raise self._translate_s3_error(error, key) from error
        except (MinioException, HTTPError, ParseError, OSError) as error:
            log.warning("the object store at %s failed: %s", self.endpoint, error)
            raise self._unreachable_error(error) from error

    def missing(self) -> Unavailable:
        return Unavailable(
            "bucket_not_found",
            f"The object store at {self.endpoint} has no bucket {self.name!r} (S3_BUCKET). "
            "Make it: placewise storage create-bucket.",
        )

    def _translate_s3_error(self, error: S3Error, key: str | None) -> PlacewiseError:
        code = error.code or ""
        if code in NO_SUCH_KEY_CODES and key is not None:
            return NotFound("object_not_found", f"The object store has no {key!r}.", key=key)
        if code in NO_SUCH_BUCKET_CODES:
            return self.missing()
        log.warning("the object store at %s refused: %s", self.endpoint, error)
        if code in PRECONDITION_FAILED_CODES:
            return Unavailable("object_changed", f"{key!r} was written anew while it was read.")
        if code in STORAGE_FULL_CODES or error.response.status == INSUFFICIENT_STORAGE_STATUS:
            return StorageFull(
                "object_store_full",
                f"The object store at {self.endpoint} has no room left ({code}). Give it more, or "
                "delete photos or maps.",
                retry_after_seconds=FULL_RETRY_SECONDS,
            )
        if code in SLOW_DOWN_CODES:
            return Unavailable(
                "object_store_busy",
                f"The object store at {self.endpoint} is asked too much ({code}). Try again.",
                retry_after_seconds=BUSY_RETRY_SECONDS,
            )
        advice = _advice(code, self.name)
        if advice is None:
            return Unavailable(
                "object_store_unavailable",
                f"The object store at {self.endpoint} can't do this now: {code} {error.message}",
            )
        return Unavailable(
            "object_store_refused",
            f"The object store at {self.endpoint} refuses Placewise ({code}). {advice}",
        )

    def _unreachable_error(self, error: Exception) -> Unavailable:
        reason: object = error.reason if isinstance(error, MaxRetryError) else error
        if isinstance(reason, SSLError):
            advice = "Check S3_SECURE: does it speak HTTPS, with a certificate that holds here?"
        elif isinstance(error, MinioException | ParseError):
            advice = "It does not answer as S3 does: check S3_ENDPOINT and S3_SECURE."
        else:
            advice = "Check S3_ENDPOINT, and that it runs."
        return Unavailable(
            "object_store_unavailable",
            f"The object store at {self.endpoint} can't be reached ({type(reason).__name__}). "
            f"{advice}",
        )


def _is_timeout(error: Exception) -> bool:
    """Was the time limit reached: while connecting, sending or waiting for an answer?"""
    if isinstance(error, ProtocolError):
        return any(isinstance(cause, TimeoutError) for cause in error.args)
    return isinstance(error, ReadTimeoutError | ConnectTimeoutError)


def _advice(code: str, bucket: str) -> str | None:
    """What to do about a refusal; None for what is no refusal."""
    if code in BAD_CREDENTIALS_CODES:
        return "Check S3_ACCESS_KEY and S3_SECRET_KEY."
    if code in ACCESS_DENIED_CODES:
        return (
            "Check S3_ACCESS_KEY and S3_SECRET_KEY, and that they may read, write, list and delete "
            f"in the bucket {bucket!r}."
        )
    if code in WRONG_REGION_CODES:
        return "Set S3_REGION to the region of the bucket."
    if code in CLOCK_SKEW_CODES:
        return "This machine's clock is wrong, or the store's."
    return None


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
