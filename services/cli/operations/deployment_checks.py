"""Checks of `placewise doctor` for a deployment of separate services.

The first part checks the services themselves (search workers, gateways, extractors, stewards), the
second part the servers that they depend on: PostgreSQL, Redis and S3. Each check returns a summary
and raises a PlacewiseError whose `detail` says what to do.
"""

from __future__ import annotations

import contextlib
import time
from collections import defaultdict
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

import httpx2
from sqlalchemy import func, select, text
from sqlalchemy.exc import SQLAlchemyError

from shared.catalog.database.base import db_now, db_now_plus
from shared.catalog.database.errors import explain_outage
from shared.catalog.database.schema import check_schema
from shared.catalog.database.session import Catalog
from shared.catalog.jobs import UNFINISHED_STATES, Job
from shared.catalog.processes import ProcessStatus, list_processes
from shared.catalog.tables import open_catalog
from shared.config.settings import Settings
from shared.errors import Misconfigured, PlacewiseError, Unavailable
from shared.ids import new_id
from shared.search_api.workers import WorkerUnavailable, fetch_status
from shared.storage.open_store import open_store

# How long a lease may be expired before it counts as overdue. The steward checks every second.
OVERDUE_LEASE_SECONDS = 30.0
SEARCH_TIMEOUT_SECONDS = 5.0
MAX_LAG_SECONDS = 30.0
MAX_NAMED_CHUNKS = 10
SEE_POSTGRES = "See the check postgresql."


@contextlib.contextmanager
def open_for_check(settings: Settings, advice: str) -> Iterator[Catalog]:
    """Open the catalog of the settings.

    Raises:
        Unavailable: The database can't be reached.
        Misconfigured: `catalog_unreadable` with `advice`, for its other errors.
    """
    with contextlib.closing(open_catalog(settings, "doctor")) as catalog:
        try:
            yield catalog
        except SQLAlchemyError as error:
            raise explain_outage(error) or Misconfigured(
                "catalog_unreadable",
                f"The catalog can't be read ({type(error).__name__}). {advice}",
            ) from error


def check_search(settings: Settings) -> str:
    """Check every worker of SEARCH_URLS and that each shard has a worker.

    Raises:
        Misconfigured: `search_missing` if SEARCH_URLS is not set.
        Unavailable: `search_ill` for missing shards and for workers that lag behind, can't read
            chunks, lost a device or use another number of shards.
    """
    if not settings.search_worker_urls:
        raise Misconfigured(
            "search_missing",
            "SEARCH_URLS is not set. List the URL of every search worker, for example "
            "http://search-0:8000,http://search-1:8000.",
        )
    shards: dict[str, int] = {}
    unreachable, problems, rows = [], [], 0
    with httpx2.Client() as http:
        for url in settings.search_worker_urls:
            try:
                status = fetch_status(http, url, SEARCH_TIMEOUT_SECONDS)
            except (WorkerUnavailable, PlacewiseError) as error:
                unreachable.append(str(error))
                continue
            shards[status.shard] = shards.get(status.shard, 0) + 1
            rows += status.rows
            lag_seconds = max(
                (lag.seconds for lag in status.lags.values() if lag.answers), default=0.0
            )
            if lag_seconds > MAX_LAG_SECONDS:
                problems.append(f"{url} lags {lag_seconds:.0f} s behind the catalog")
            if status.missing:
                chunks = ", ".join(status.missing[:MAX_NAMED_CHUNKS])
                problems.append(
                    f"{url} can't read {len(status.missing)} chunks and searches without them: "
                    f"{chunks} (run placewise verify --repair)"
                )
            problems += [
                f"{url}: device {d.name} failed" for d in status.devices if d.failure is not None
            ]
    counts = {int(shard.split("/")[1]) for shard in shards}
    missing_shards = [
        f"{number}/{count}"
        for count in counts
        for number in range(count)
        if f"{number}/{count}" not in shards
    ]
    if not shards or missing_shards or problems or len(counts) > 1:
        problems += [f"no worker serves shard {shard}" for shard in missing_shards]
        if len(counts) > 1:
            problems.append("SEARCH_SHARD has different shard counts: " + ", ".join(shards))
        problems += [f"unreachable: {error}" for error in unreachable]
        raise Unavailable("search_ill", "; ".join(problems) + ". Check the logs of these workers.")
    summary = f"{len(shards)} shards, {sum(shards.values())} workers, {rows} rows"
    if unreachable:
        summary += f"; unreachable: {'; '.join(unreachable)} (other workers serve their shards)"
    return summary


def check_processes(settings: Settings, role: str) -> str:
    """Check that at least one process of a role has a recent heartbeat.

    Raises:
        Unavailable: `nobody_there`.
    """
    with open_for_check(settings, SEE_POSTGRES) as catalog, catalog.read() as session:
        processes = [p for p in list_processes(session) if p.role == role]
    live = [process for process in processes if process.is_live]
    if live:
        return _names_by_release(live)
    last = min((p.seconds_since_heartbeat for p in processes), default=None)
    hint = "" if last is None else f" The last heartbeat was {last:.0f} s ago."
    if role == "extractor":
        hint += " (This is expected if KEDA scaled extractors to zero because no job is queued.)"
    raise Unavailable(
        "nobody_there",
        f"No {role} is running.{hint} Start one with placewise {role}, or check its log.",
    )


def check_steward(settings: Settings) -> str:
    """Check that a steward runs and that expired leases are released.

    Raises:
        Unavailable: `nobody_there`, `leases_overdue`.
    """
    summary = check_processes(settings, "steward")
    is_overdue = Job.lease_until < db_now_plus(-OVERDUE_LEASE_SECONDS)
    count = select(func.count()).where(Job.state.in_(UNFINISHED_STATES), is_overdue)
    with open_for_check(settings, SEE_POSTGRES) as catalog, catalog.read() as session:
        overdue = session.scalar(count)
    if overdue:
        raise Unavailable(
            "leases_overdue",
            f"{summary}; but {overdue} jobs have leases that expired more than "
            f"{OVERDUE_LEASE_SECONDS:.0f} s ago. Check the steward's log.",
        )
    return f"{summary}; no overdue leases"


def check_gateway(server: str, key: str | None) -> str:
    """Check the health that a gateway reports.

    Raises:
        Unavailable: `server_unreachable`, or `gateway_ill` if one of its dependencies is unhealthy.
        Misconfigured: The answer is an error (with its code) or not a health report.
    """
    body = read_health(server, key)
    unhealthy = {name: part for name, part in body["parts"].items() if part["status"] != "healthy"}
    if unhealthy:
        problems = "; ".join(
            f"{name} is {part['status']}: {part['detail']}" for name, part in unhealthy.items()
        )
        raise Unavailable("gateway_ill", f"{server} reports: {problems}")
    load = body["load"]
    return (
        f"{server} is healthy ({body['version']}): {load['waiting_jobs']} jobs queued, "
        f"{load['finished_per_second']:.1f} photos/s"
    )


def read_health(server: str, key: str | None) -> dict[str, Any]:
    """Return the response of `GET /health`, whatever its status.

    Raises:
        Unavailable: `server_unreachable`.
        Misconfigured: The answer is an error (with its code) or not a health report.
    """
    try:
        response = httpx2.get(
            f"{server.rstrip('/')}/api/v1/health",
            headers={"Authorization": f"Bearer {key}"} if key else {},
            timeout=10,
        )
        body: dict[str, Any] = response.json()
    except (httpx2.HTTPError, ValueError) as error:
        raise Unavailable(
            "server_unreachable",
            f"{server} does not answer ({type(error).__name__}). Check the gateway's URL.",
        ) from error
    if "parts" not in body:
        raise Misconfigured(body.get("code", "bad_answer"), body.get("detail", response.text[:200]))
    return body


def _names_by_release(processes: list[ProcessStatus]) -> str:
    by_release: dict[str, list[str]] = defaultdict(list)
    for process in processes:
        by_release[process.release].append(process.name)
    return "; ".join(
        f"{len(names)} of release {release}: {', '.join(names)}"
        for release, names in sorted(by_release.items())
    )


MIN_POSTGRES_VERSION = 140000  # server_version_num
MIN_REDIS_VERSION = (6, 2)
# S3 rejects signatures from a skew of 900 s; object ages are compared with the catalog's clock.
MAX_CLOCK_SKEW_SECONDS = 60.0
PROBE_BYTES = b"placewise doctor"


def check_postgres(settings: Settings) -> str:
    """Check the connection to PostgreSQL, its version, the schema revision and its clock.

    Raises:
        Misconfigured: `postgres_too_old`, `catalog_unreadable`, `clocks_differ`, and the errors of
            `check_schema`.
        Unavailable: The database can't be reached.
    """
    advice = "Check DATABASE_URL and the privileges of its user."
    with open_for_check(settings, advice) as catalog:
        with catalog.read() as session:
            number = int(session.scalar(text("SHOW server_version_num")) or 0)
            now = session.execute(select(db_now())).scalar_one()
        if number < MIN_POSTGRES_VERSION:
            raise Misconfigured(
                "postgres_too_old",
                f"PostgreSQL {number // 10000} is too old. Upgrade to 14 or newer.",
            )
        check_schema(catalog)
    skew = (datetime.now(UTC) - now).total_seconds()
    _check_clock_skew("PostgreSQL", skew)
    return (
        f"PostgreSQL {number // 10000}.{number % 10000}, schema up to date, "
        f"clock skew {abs(skew):.1f} s"
    )


def check_redis(settings: Settings) -> str:
    """Check the connection to Redis, its version and that it does not evict keys.

    Raises:
        Misconfigured: `redis_missing`, `redis_too_old`, `redis_evicts`.
        Unavailable: `redis_unavailable`.
    """
    if settings.redis_url is None:
        raise Misconfigured(
            "redis_missing",
            "REDIS_URL is not set. Workers receive wake-up messages through Redis: set REDIS_URL.",
        )
    from redis import Redis  # not installed in every image
    from redis.exceptions import RedisError

    with Redis.from_url(
        settings.redis_url.get_secret_value(), socket_timeout=5, socket_connect_timeout=5
    ) as redis:
        try:
            info = redis.info("server")
        except (RedisError, OSError) as error:
            raise Unavailable(
                "redis_unavailable",
                f"Redis (REDIS_URL) does not answer: {error}. Start it, or correct the address or "
                "the password. Meanwhile, workers find jobs by polling the database.",
            ) from error
        try:
            config = redis.config_get("maxmemory-policy")
        except RedisError:  # some providers disable CONFIG
            config = {}
    version = str(info["redis_version"])
    if tuple(int(part) for part in version.split(".")[:2]) < MIN_REDIS_VERSION:
        raise Misconfigured(
            "redis_too_old", f"Redis {version} is too old. Upgrade to 6.2 or newer."
        )
    policy = config.get("maxmemory-policy", "unknown")
    if policy not in ("noeviction", "unknown"):
        raise Misconfigured(
            "redis_evicts",
            f"Redis evicts keys when its memory is full (maxmemory-policy {policy}). "
            "Set maxmemory-policy noeviction.",
        )
    eviction = "no eviction" if policy == "noeviction" else "eviction policy unknown"
    return f"Redis {version} answers, {eviction}"


def check_object_store(settings: Settings) -> str:
    """Write, read, list and delete a probe object, and check the store's clock.

    Raises:
        Misconfigured: `object_store_forgets` if the store is not read-after-write consistent;
            `object_store_unfit` if it ignores ranges or prefixes; `clocks_differ`.
        Unavailable: The store can't be reached.
    """
    store = open_store(settings, exclusive=False)
    store.check()  # some servers create missing buckets on write: a misspelt name must fail here
    key = f"work/doctor-{new_id()}/probe"
    started = time.perf_counter()
    try:
        store.put(key, PROBE_BYTES)
        info = store.head(key)
        if info is None or info.size_bytes != len(PROBE_BYTES):
            raise Misconfigured(
                "object_store_forgets",
                "An object is missing right after it was written: the store is not "
                "read-after-write consistent. Use one of the S3 servers of docs/how-to.",
            )
        if store.read_range(key, 5, 6) != PROBE_BYTES[5:11] or key not in {
            listed.key for listed in store.list(key.rpartition("/")[0] + "/")
        }:
            raise Misconfigured(
                "object_store_unfit",
                "The store ignores byte ranges or does not list by prefix. Use another one.",
            )
    finally:
        store.delete(key)
    seconds = time.perf_counter() - started
    skew = (datetime.now(UTC) - info.modified_at).total_seconds()
    _check_clock_skew("the object store", skew)
    location = (
        f"S3_BUCKET {settings.s3_bucket} at {settings.s3_endpoint}"
        if settings.s3_endpoint
        else "the folder"
    )
    return (
        f"{location}: wrote, read, listed and deleted an object in {seconds:.2f} s, "
        f"clock skew {abs(skew):.1f} s"
    )


def _check_clock_skew(server_name: str, seconds: float) -> None:
    if abs(seconds) > MAX_CLOCK_SKEW_SECONDS:
        raise Misconfigured(
            "clocks_differ",
            f"The clocks of {server_name} and of this machine differ by {abs(seconds):.0f} s. "
            "Synchronise them with NTP: otherwise signatures expire and ages of orphaned objects "
            "are wrong.",
        )
