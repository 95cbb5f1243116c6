"""The signature of a webhook, as the Standard Webhooks specification 1.0 has it."""

from __future__ import annotations

import base64
import hashlib
import hmac

from shared.catalog.webhooks import SECRET_PREFIX


def sign_webhook(secret: str, message_id: str, timestamp_seconds: int, body: str) -> str:
    """`v1,` and the base64 of HMAC-SHA256 over `id.timestamp.body`.

    `secret` is `whsec_` and the key in base64; the time is Unix', so that a receiver can refuse
    what is old, and a copy of it sent again.
    """
    key = base64.b64decode(secret.removeprefix(SECRET_PREFIX))
    signed = f"{message_id}.{timestamp_seconds}.{body}".encode()
    return "v1," + base64.b64encode(hmac.new(key, signed, hashlib.sha256).digest()).decode()


def signature_headers(
    secret: str, message_id: str, timestamp_seconds: int, body: str
) -> dict[str, str]:
    """What a receiver needs to believe the body. The id is the same in every try."""
    return {
        "webhook-id": message_id,
        "webhook-timestamp": str(timestamp_seconds),
        "webhook-signature": sign_webhook(secret, message_id, timestamp_seconds, body),
    }
