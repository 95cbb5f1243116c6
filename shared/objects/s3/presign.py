"""Addresses at which whoever has one may put one object into the bucket, for a while.

AWS Signature Version 4 in the query (docs.aws.amazon.com, "Authenticating Requests: Using Query
Parameters"). The minio client signs the host alone; here the size and the checksum are signed as
well, so that nothing else can be put there on a server that checks them. Who relies on neither
looks at what was stored.
"""

from __future__ import annotations

import base64
from urllib.parse import SplitResult

from minio import signer
from minio.helpers import queryencode
from minio.time import to_amz_date

from shared.objects.port import PresignedPut
from shared.objects.s3.bucket import Bucket

UNSIGNED_PAYLOAD = "UNSIGNED-PAYLOAD"


def presign_put(
    bucket: Bucket, key: str, *, size_bytes: int, sha256: str, expires_seconds: int
) -> PresignedPut:
    """Asks the server nothing. `sha256` in hexadecimal."""
    provider, region = bucket.client._provider, bucket.region
    assert provider is not None, "the settings have both keys"
    credentials = provider.retrieve()
    url = bucket.public.build(method="PUT", region=region, bucket_name=bucket.name, object_name=key)
    checksum = base64.b64encode(bytes.fromhex(sha256)).decode()
    headers = {"Content-Length": str(size_bytes), "x-amz-checksum-sha256": checksum}
    signed = {**headers, "host": url.netloc}

    now = bucket.client.now()
    scope = signer._get_scope(now, region, "s3")
    query = "&".join(
        f"{name}={queryencode(value)}"
        for name, value in {
            "X-Amz-Algorithm": signer.SIGN_V4_ALGORITHM,
            "X-Amz-Credential": f"{credentials.access_key}/{scope}",
            "X-Amz-Date": to_amz_date(now),
            "X-Amz-Expires": str(expires_seconds),
            "X-Amz-SignedHeaders": ";".join(sorted(name.lower() for name in signed)),
        }.items()
    )
    unsigned = SplitResult(url.scheme, url.netloc, url.path, query, "")
    asked, _ = signer._get_canonical_request_hash("PUT", unsigned, signed, UNSIGNED_PAYLOAD)
    signature = signer._get_signature(
        signer._get_signing_key(credentials.secret_key, now, region, "s3"),
        signer._get_string_to_sign(now, scope, asked),
    )
    return PresignedPut(f"{unsigned.geturl()}&X-Amz-Signature={signature}", headers)
