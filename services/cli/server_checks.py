"""The doctor's look at the servers that separate services stand on: PostgreSQL, Redis, S3."""

from __future__ import annotations

import time
from datetime import UTC, datetime

from sqlalchemy import select, text
from sqlalchemy.exc import SQLAlchemyError

from shared.catalog.away import to_unavailable
from shared.catalog.base import db_now
from shared.catalog.open_catalog import open_catalog
from shared.catalog.schema import check_schema
from shared.errors import Misconfigured, Unavailable
from shared.ids import new_id
from shared.settings import Settings

MIN_POSTGRES_VERSION = 140000  # server_version_num
MIN_REDIS_VERSION = (6, 2)
# Signatures of S3 are refused from 900 s on; ages of objects are compared with the catalog's clock.
MAX_CLOCK_SKEW_SECONDS = 60.0
PROBE_BYTES = b"placewise doctor"


def check_postgres(settings: Settings) -> str:
    """Does it answer, is it new enough, are its tables those of this release, what time is it?"""
    catalog = open_catalog(settings, "doctor")
    try:
        with catalog.read() as session:
            number = int(session.scalar(text("SHOW server_version_num")) or 0)
            now = session.execute(select(db_now())).scalar_one()
        if number < MIN_POSTGRES_VERSION:
            raise Misconfigured(
                "postgres_too_old",
                f"PostgreSQL is {number // 10000}, and 14 or newer is needed: upgrade it.",
            )
        check_schema(catalog)
    except SQLAlchemyError as error:
        raise to_unavailable(error) or Misconfigured(
            "catalog_unreadable",
            f"PostgreSQL refuses ({type(error).__name__}): check DATABASE_URL, and what its user "
            "may do.",
        ) from error
    finally:
        catalog.close()
    skew = (datetime.now(UTC) - now).total_seconds()
    _check_clock_skew("PostgreSQL", skew)
    return (
        f"PostgreSQL {number // 10000}.{number % 10000}, tables up to date, "
        f"its clock {abs(skew):.1f} s from this machine's"
    )


def check_redis(settings: Settings) -> str:
    """Does it answer, and does it keep what it is given?"""
    if settings.redis_url is None:
        raise Misconfigured(
            "redis_missing", "REDIS_URL is not set: without it nobody is woken. Set it."
        )
    from redis import Redis  # not in every image
    from redis.exceptions import RedisError

    with Redis.from_url(
        settings.redis_url.get_secret_value(), socket_timeout=5, socket_connect_timeout=5
    ) as redis:
        try:
            said = redis.info("server")
        except (RedisError, OSError) as error:
            raise Unavailable(
                "redis_unavailable",
                f"Redis (REDIS_URL) does not answer: {error}. Start it, or correct the address or "
                "the password. Until then jobs are found by the workers' own looks.",
            ) from error
        try:
            found = redis.config_get("maxmemory-policy")
        except RedisError:  # some providers let nobody look at it
            found = {}
    version = str(said["redis_version"])
    if tuple(int(part) for part in version.split(".")[:2]) < MIN_REDIS_VERSION:
        raise Misconfigured("redis_too_old", f"Redis is {version}, and 6.2 or newer is needed.")
    policy = found.get("maxmemory-policy", "unknown")
    if policy not in ("noeviction", "unknown"):
        raise Misconfigured(
            "redis_evicts",
            f"Redis throws keys away when it is full (maxmemory-policy {policy}). Set noeviction.",
        )
    said_of = "evicts nothing" if policy == "noeviction" else "does not tell whether it evicts"
    return f"Redis {version} answers, and {said_of}"


def check_object_store(settings: Settings) -> str:
    """Write, look, read a range, delete; and the clock of whoever keeps the objects."""
    from shared.objects.open_store import open_store  # the minio client takes its time

    store = open_store(settings, exclusive=False)
    store.check()  # some servers make a bucket of the first object: a misspelt name would go unseen
    key = f"work/doctor-{new_id()}/probe"
    started = time.perf_counter()
    try:
        store.put(key, PROBE_BYTES)
        info = store.head(key)
        if info is None or info.size_bytes != len(PROBE_BYTES):
            raise Misconfigured(
                "object_store_forgets",
                "What was written a moment ago is not there: the store is not consistent. Use one "
                "that gives read-after-write (every S3 server of docs/how-to does).",
            )
        if store.read_range(key, 5, 6) != PROBE_BYTES[5:11] or key not in {
            found.key for found in store.list(key.rpartition("/")[0] + "/")
        }:
            raise Misconfigured(
                "object_store_unfit", "The store ignores ranges or lists nothing: use another one."
            )
    finally:
        store.delete(key)
    took = time.perf_counter() - started
    skew = (datetime.now(UTC) - info.modified_at).total_seconds()
    _check_clock_skew("the object store", skew)
    where = (
        f"S3_BUCKET {settings.s3_bucket} at {settings.s3_endpoint}"
        if settings.s3_endpoint
        else "the folder"
    )
    return (
        f"{where}: written, read, listed and deleted in {took:.2f} s, clock {abs(skew):.1f} s off"
    )


def _check_clock_skew(server_name: str, seconds: float) -> None:
    if abs(seconds) > MAX_CLOCK_SKEW_SECONDS:
        raise Misconfigured(
            "clocks_differ",
            f"The clocks of {server_name} and of this machine are {abs(seconds):.0f} s apart. Set them "
            "by NTP: signatures expire, and orphans are taken for older or younger than they are.",
        )
