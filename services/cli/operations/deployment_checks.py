"""The doctor's look at separate services: who lives, and what each says of itself.

The doctor's look at the servers that separate services stand on: PostgreSQL, Redis, S3.
"""

from __future__ import annotations

import time
from collections import defaultdict
from datetime import UTC, datetime

import httpx2
from sqlalchemy import func, select, text
from sqlalchemy.exc import SQLAlchemyError

from shared.catalog.base import db_now, db_now_plus
from shared.catalog.database_errors import to_unavailable
from shared.catalog.jobs import UNFINISHED_STATES, Job
from shared.catalog.processes import PROCESS_TIMEOUT_SECONDS, ProcessStatus, list_processes
from shared.catalog.schema import check_schema
from shared.catalog.session import Catalog
from shared.catalog.tables import open_catalog
from shared.config.settings import Settings
from shared.errors import Misconfigured, PlacewiseError, Unavailable
from shared.ids import new_id
from shared.search_api.workers import WorkerUnavailable, fetch_status

OVERDUE_LEASE_SECONDS = (
    30.0  # for which an expired lease may lie there: the steward looks every second
)
SEARCH_TIMEOUT_SECONDS = 5.0
MAX_LAG_SECONDS = 30.0
MAX_NAMED_CHUNKS = 10


def check_search(settings: Settings) -> str:
    """Each worker of SEARCH_URLS, and whether every shard is answered for."""
    if not settings.search_worker_urls:
        raise Misconfigured(
            "search_missing",
            "SEARCH_URLS is not set: name every search worker, for example "
            "http://search-0:8000,http://search-1:8000.",
        )
    shards: dict[str, int] = {}
    away, ill, rows = [], [], 0
    with httpx2.Client() as http:
        for url in settings.search_worker_urls:
            try:
                status = fetch_status(http, url, SEARCH_TIMEOUT_SECONDS)
            except (WorkerUnavailable, PlacewiseError) as error:
                away.append(str(error))
                continue
            shards[status.shard] = shards.get(status.shard, 0) + 1
            rows += status.rows
            late = max((lag.seconds for lag in status.lags.values() if lag.answers), default=0.0)
            if late > MAX_LAG_SECONDS:
                ill.append(f"{url} is {late:.0f} s behind")
            if status.missing:
                named = ", ".join(status.missing[:MAX_NAMED_CHUNKS])
                ill.append(
                    f"{url} can't read {len(status.missing)} chunks, and answers without them: "
                    f"{named} (placewise verify --repair)"
                )
            ill += [f"{url}: {d.name} failed" for d in status.devices if d.failure is not None]
    counts = {int(shard.split("/")[1]) for shard in shards}
    unanswered = [
        f"{number}/{count}"
        for count in counts
        for number in range(count)
        if f"{number}/{count}" not in shards
    ]
    if not shards or unanswered or ill or len(counts) > 1:
        wrong = [*ill, *(f"nobody answers for shard {shard}" for shard in unanswered)]
        wrong += ["SEARCH_SHARD divides differently: " + ", ".join(shards)] * (len(counts) > 1)
        wrong += [f"away: {one}" for one in away]
        raise Unavailable("search_ill", "; ".join(wrong) + ". Look at those workers' logs.")
    answered = f"{len(shards)} shards, {sum(shards.values())} workers, {rows} rows"
    return answered + (f"; away: {'; '.join(away)} (their shards have others)" if away else "")


def check_processes(settings: Settings, role: str) -> str:
    """Who of this role gave a sign of life in the last seconds."""
    catalog = open_catalog(settings, "doctor")
    try:
        with catalog.read() as session:
            known = [one for one in list_processes(session) if one.role == role]
    except SQLAlchemyError as error:
        raise _catalog_error(error) from error
    finally:
        catalog.close()
    live = [one for one in known if one.seconds_since_heartbeat < PROCESS_TIMEOUT_SECONDS]
    if live:
        return _names_by_release(live)
    last = min((one.seconds_since_heartbeat for one in known), default=None)
    seen = "" if last is None else f" The last sign of one is {last:.0f} s old."
    if role == "extractor":
        seen += " (Scaled to none by KEDA, that is as it should be while no job waits.)"
    raise Unavailable(
        "nobody_there", f"No {role} lives.{seen} Start one: placewise {role}; its log says more."
    )


def check_steward(settings: Settings) -> str:
    """Whether one lives, and does what only a steward does."""
    said = check_processes(settings, "steward")
    catalog = open_catalog(settings, "doctor")
    try:
        overdue = _count_overdue_leases(catalog)
    except SQLAlchemyError as error:
        raise _catalog_error(error) from error
    finally:
        catalog.close()
    if overdue:
        raise Unavailable(
            "leases_overdue",
            f"{said}; and {overdue} jobs of dead workers were not given back for "
            f"{OVERDUE_LEASE_SECONDS:.0f} s. Look at the steward's log.",
        )
    return f"{said}; no lease is overdue"


def check_gateway(server: str, key: str | None) -> str:
    """What the gateway says of the parts that it needs."""
    try:
        answer = httpx2.get(
            f"{server.rstrip('/')}/api/v1/health",
            headers={"Authorization": f"Bearer {key}"} if key else {},
            timeout=10,
        )
        said = answer.json()
    except (httpx2.HTTPError, ValueError) as error:
        raise Unavailable(
            "server_unreachable",
            f"{server} does not answer ({type(error).__name__}). Is it the gateway's address?",
        ) from error
    if "parts" not in said:
        raise Misconfigured(said.get("code", "bad_answer"), said.get("detail", answer.text[:200]))
    ill = {name: part for name, part in said["parts"].items() if part["status"] != "healthy"}
    if ill:
        wrong = "; ".join(
            f"{name} is {part['status']}: {part['detail']}" for name, part in ill.items()
        )
        raise Unavailable("gateway_ill", f"{server} answers, and says: {wrong}")
    load = said["load"]
    return (
        f"{server} is healthy ({said['version']}): {load['waiting_jobs']} jobs wait, "
        f"{load['finished_per_second']:.1f} photos a second"
    )


def _count_overdue_leases(catalog: Catalog) -> int:
    with catalog.read() as session:
        return (
            session.scalar(
                select(func.count())
                .select_from(Job)
                .where(
                    Job.state.in_(UNFINISHED_STATES),
                    Job.lease_until < db_now_plus(-OVERDUE_LEASE_SECONDS),
                )
            )
            or 0
        )


def _names_by_release(processes: list[ProcessStatus]) -> str:
    by_release: dict[str, list[str]] = defaultdict(list)
    for one in processes:
        by_release[one.release].append(one.name)
    return "; ".join(
        f"{len(names)} of release {release}: {', '.join(names)}"
        for release, names in sorted(by_release.items())
    )


def _catalog_error(error: SQLAlchemyError) -> PlacewiseError:
    return to_unavailable(error) or Misconfigured(
        "catalog_unreadable",
        f"The catalog can't be asked ({type(error).__name__}): see postgresql.",
    )


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
    from shared.storage.open_store import open_store  # the minio client takes its time

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
            f"The clocks of {server_name} and of this machine are {abs(seconds):.0f} s "
            "apart. Set them "
            "by NTP: signatures expire, and orphans are taken for older or younger than they are.",
        )
