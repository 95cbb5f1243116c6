"""The doctor's look at separate services: who lives, and what each says of itself."""

from __future__ import annotations

from collections import defaultdict

import httpx2
from sqlalchemy import func, select
from sqlalchemy.exc import SQLAlchemyError

from shared.catalog.away import to_unavailable
from shared.catalog.base import db_now_plus
from shared.catalog.live_processes import PROCESS_TIMEOUT_SECONDS, ProcessStatus, list_processes
from shared.catalog.open_catalog import open_catalog
from shared.catalog.session import Catalog
from shared.errors import Misconfigured, PlacewiseError, Unavailable
from shared.jobs.table import UNFINISHED_STATES, Job
from shared.search_http.worker_call import WorkerUnavailable, fetch_status
from shared.settings import Settings

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
