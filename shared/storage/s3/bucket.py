"""A bucket and its client, the translation of S3 errors, and the creation of the bucket."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from email.utils import parsedate_to_datetime
from types import TracebackType
from typing import Any, Self
from xml.etree.ElementTree import ParseError

import urllib3
from minio import Minio
from minio.commonconfig import ENABLED, Filter
from minio.credentials.providers import StaticProvider
from minio.error import MinioException, S3Error
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
from shared.errors import Misconfigured, PlacewiseError, StorageFull, Unavailable
from shared.storage.keys import object_not_found_error

log = logging.getLogger(__name__)

MAX_CONNECTIONS = 32  # open connections: the concurrent threads of one process
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
FORBIDDEN_STATUS = 403
MAX_CLOCK_SKEW = timedelta(minutes=15)  # S3 rejects signatures with a larger one
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


class _RetryUnlessTimeout(urllib3.Retry):
    """Retries requests that were rejected or disconnected, but never those that timed out.

    Retrying after a timeout would double the time limit.
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
    """One bucket on one server. Its client is thread-safe."""

    client: Minio
    name: str
    endpoint: str
    settings: Settings

    def __reduce__(self) -> tuple[Any, ...]:
        return Bucket.from_settings, (self.settings,)  # decoders get it with connections of its own

    @classmethod
    def from_settings(cls, settings: Settings) -> Bucket:
        """Return the configured bucket, without sending a request to the server.

        Raises Misconfigured (`bad_setting`) when S3_ENDPOINT or its keys are not set.
        """
        if not (settings.s3_endpoint and settings.s3_access_key and settings.s3_secret_key):
            raise Misconfigured(
                "bad_setting",
                "An S3 bucket needs S3_ENDPOINT (host:port), S3_ACCESS_KEY and S3_SECRET_KEY.",
            )
        # One timeout for both: urllib3 applies the connect timeout to sending the body.
        seconds = settings.s3_timeout_seconds
        connections = urllib3.PoolManager(
            num_pools=2,
            maxsize=MAX_CONNECTIONS,
            timeout=urllib3.Timeout(connect=seconds, read=seconds),
            retries=_RetryUnlessTimeout(
                total=1,
                backoff_factor=RETRY_SECONDS,
                status_forcelist=(500, 502, 503, 504),
                raise_on_status=False,
                respect_retry_after_header=False,  # the server may ask for minutes
            ),
            cert_reqs="CERT_REQUIRED",  # by the system's certificate authorities, or SSL_CERT_FILE
        )
        credentials = StaticProvider(
            settings.s3_access_key, settings.s3_secret_key.get_secret_value()
        )
        client = Minio(
            settings.s3_endpoint,
            credentials=credentials,
            secure=settings.s3_secure,
            region=settings.s3_region,  # without it the client would request it first
            http_client=connections,
        )
        return cls(client, settings.s3_bucket, settings.s3_endpoint, settings)

    @contextlib.contextmanager
    def translate_errors(self, key: str | None = None) -> Iterator[None]:
        """Convert the client's exceptions inside the block into those of Placewise.

        Wrong credentials and a missing bucket are Unavailable too: an operator can correct them
        while jobs wait, so that the jobs are retried instead of failing permanently.

        Raises:
            NotFound: `object_not_found`, only with a `key`.
            Unavailable: `object_store_unavailable`, `object_store_busy`, `object_store_refused`,
                `bucket_not_found`, `object_changed`.
            StorageFull: `object_store_full`.
        """
        try:
            yield
        except S3Error as error:
            raise self._translate_s3_error(error, key) from error
        except (MinioException, HTTPError, ParseError, ValueError, OSError) as error:
            log.warning("the object store at %s failed: %s", self.endpoint, error)
            raise self._unreachable_error(error) from error

    def incomplete_response_error(self, key: str) -> Unavailable:
        return Unavailable(
            "object_store_unavailable",
            f"The object store at {self.endpoint} sent an incomplete response for {key!r}.",
        )

    def missing_error(self) -> Unavailable:
        return Unavailable(
            "bucket_not_found",
            f"The object store at {self.endpoint} has no bucket {self.name!r} (S3_BUCKET). "
            "Create it with: placewise storage create-bucket.",
        )

    def _translate_s3_error(self, error: S3Error, key: str | None) -> PlacewiseError:
        code = error.code or ""
        if code in NO_SUCH_KEY_CODES and key is not None:
            return object_not_found_error(key)
        if code in NO_SUCH_BUCKET_CODES:
            return self.missing_error()
        log.warning("the object store at %s rejected a request: %s", self.endpoint, error)
        if code in PRECONDITION_FAILED_CODES:
            return Unavailable("object_changed", f"{key!r} was overwritten while it was read.")
        if code in STORAGE_FULL_CODES or error.response.status == INSUFFICIENT_STORAGE_STATUS:
            return StorageFull(
                "object_store_full",
                f"The object store at {self.endpoint} is full ({code}). Add storage, or delete "
                "photos or maps.",
                retry_after_seconds=FULL_RETRY_SECONDS,
            )
        if code in SLOW_DOWN_CODES:
            return Unavailable(
                "object_store_busy",
                f"The object store at {self.endpoint} is overloaded ({code}). Try again.",
                retry_after_seconds=BUSY_RETRY_SECONDS,
            )
        if error.response.status == FORBIDDEN_STATUS and _is_clock_wrong(error.response):
            code = "RequestTimeTooSkewed"  # a response to HEAD has no body with the code
        advice = _advice(code, self.name)
        if advice is None:
            return Unavailable(
                "object_store_unavailable",
                f"The object store at {self.endpoint} failed: {code} {error.message}",
            )
        return Unavailable(
            "object_store_refused",
            f"The object store at {self.endpoint} rejected the request ({code}). {advice}",
        )

    def _unreachable_error(self, error: Exception) -> Unavailable:
        reason: object = error.reason if isinstance(error, MaxRetryError) else error
        if isinstance(reason, SSLError):
            advice = "Check S3_SECURE, and that the server uses HTTPS with a trusted certificate."
        elif isinstance(error, MinioException | ParseError | ValueError):
            advice = "The response is not from an S3 server: check S3_ENDPOINT and S3_SECURE."
        else:
            advice = "Check S3_ENDPOINT, and that the server is running."
        return Unavailable(
            "object_store_unavailable",
            f"The object store at {self.endpoint} can't be reached ({type(reason).__name__}). "
            f"{advice}",
        )


def _is_timeout(error: Exception) -> bool:
    """Return whether the error is a timeout: of connecting, sending or reading."""
    if isinstance(error, ProtocolError):
        return any(isinstance(cause, TimeoutError) for cause in error.args)
    return isinstance(error, ReadTimeoutError | ConnectTimeoutError)


def _advice(code: str, bucket: str) -> str | None:
    """Return what to do about a rejected request; None for any other error."""
    if code in BAD_CREDENTIALS_CODES:
        return "Check S3_ACCESS_KEY and S3_SECRET_KEY."
    if code in ACCESS_DENIED_CODES:
        return (
            "Check S3_ACCESS_KEY and S3_SECRET_KEY, and that they have permission to read, write, "
            f"list and delete objects in the bucket {bucket!r}."
        )
    if code in WRONG_REGION_CODES:
        return "Set S3_REGION to the region of the bucket."
    if code in CLOCK_SKEW_CODES:
        return (
            "The clocks of this machine and of the object store differ by more than "
            f"{MAX_CLOCK_SKEW.seconds // 60} minutes: synchronise both with NTP."
        )
    return None


def _is_clock_wrong(response: BaseHTTPResponse) -> bool:
    """Return whether this machine's clock differs too much from the response's Date header."""
    try:
        server_time = parsedate_to_datetime(response.headers["date"])
    except (KeyError, ValueError):
        return False
    return server_time.tzinfo is not None and (
        abs(server_time - datetime.now(UTC)) > MAX_CLOCK_SKEW
    )


ALREADY_OWNED_CODE = "BucketAlreadyOwnedByYou"
LIFECYCLE_UNSUPPORTED_CODES = {"NotImplemented", "MethodNotAllowed"}
ABORT_UPLOADS_AFTER_DAYS = 1  # the minimum of S3

# Parts of the unfinished uploads of killed writers are not listed as objects, but take up space.
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
    """Create the bucket, and add a rule for unfinished uploads unless it has lifecycle rules.

    Returns:
        True if the bucket was created, False if it existed.

    Raises:
        Unavailable: as `Bucket.translate_errors`.
    """
    client = bucket.client
    with bucket.translate_errors():
        created = not client.bucket_exists(bucket.name)
        if created:
            try:
                client.make_bucket(bucket.name)
            except S3Error as error:
                if error.code != ALREADY_OWNED_CODE:
                    raise
                created = False  # by another process, since the check
        try:
            if client.get_bucket_lifecycle(bucket.name) is None:
                client.set_bucket_lifecycle(bucket.name, LIFECYCLE_RULES)
        except S3Error as error:
            if error.code not in LIFECYCLE_UNSUPPORTED_CODES:
                raise
            log.warning(
                "the object store at %s does not support lifecycle rules: unfinished uploads of "
                "killed processes stay in the bucket %s until an operator removes them",
                bucket.endpoint,
                bucket.name,
            )
    return created
