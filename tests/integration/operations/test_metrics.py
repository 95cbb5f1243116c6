"""The metrics of a Placewise at work; dashboards and alerts use only metrics that exist."""

from __future__ import annotations

import json
import re
import urllib.request
from pathlib import Path
from typing import Any

import pytest
import yaml
from prometheus_client import CollectorRegistry

from services.extractor.metrics import ExtractorMetrics
from services.gateway.app import create_app
from services.gateway.authentication import LocalhostAuthenticator
from services.gateway.dependencies import GatewayContext
from services.gateway.metrics import count_jobs
from services.search.metrics import MeteredSearch
from services.search.worker import SearchWorker
from services.steward.metrics import StewardMetrics
from services.steward.scheduler import Scheduler
from shared.catalog.database.session import Catalog
from shared.catalog.jobs import JobKind, WaitingFor
from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.jobs import InProcessWakeups, JobState
from shared.storage import FolderStore
from shared.telemetry.metrics_server import serve_metrics
from tests.integration.harness import Harness
from tests.integration.in_process_api import Service
from tests.support.catalog_rows import add_job, add_map, expire_lease, take
from tests.support.metrics import ADDED, exported, read
from tests.support.photos import photo_bytes

pytestmark = pytest.mark.databases("postgresql")

DEPLOY = Path(__file__).parents[3] / "deploy"
NAME = re.compile(r"\b(?:placewise_\w+|up)\b(?!\()")
# PromQL's words and the labels that Prometheus itself gives.
LABELS_ADDED = {"job", "instance", "le"}


@pytest.fixture
def whole(catalog: Catalog, store: FolderStore, settings: Settings) -> CollectorRegistry:
    """The registry of all services together, as the embedded Placewise has it."""
    registry = CollectorRegistry()
    search = SearchWorker(catalog, store, settings)
    counted = MeteredSearch(search, registry)
    create_app(
        GatewayContext(
            catalog,
            store,
            InProcessWakeups(),
            counted,
            settings,
            LocalhostAuthenticator(),
            registry,
        )
    )
    ExtractorMetrics(registry)
    StewardMetrics(registry)
    return registry


def expressions() -> list[tuple[str, str]]:
    """(where, PromQL) of every alert and every panel."""
    found = []
    rules = yaml.safe_load((DEPLOY / "prometheus/alerts.yml").read_text())
    for group in rules["groups"]:
        found += [(rule["alert"], rule["expr"]) for rule in group["rules"]]
    for file in sorted((DEPLOY / "grafana/dashboards").glob("*.json")):
        for panel in json.loads(file.read_text())["panels"]:
            found += [
                (f"{file.stem}: {panel['title']}", target["expr"]) for target in panel["targets"]
            ]
    return found


def test_alerts_and_dashboards_name_only_what_the_services_export(
    whole: CollectorRegistry,
) -> None:
    there = exported(whole)
    # Samples that exist only while there is something to tell.
    for name, labels in {
        "placewise_gateway_jobs": {"kind", "state"},
        "placewise_gateway_oldest_job_seconds": {"kind", "state"},
        "placewise_search_snapshot_version": {"generation"},
        "placewise_search_snapshot_lag_seconds": {"generation"},
        "placewise_search_snapshot_lag_versions": {"generation"},
        "placewise_extractor_device_used_bytes": {"device"},
        "placewise_extractor_device_total_bytes": {"device"},
        "placewise_steward_task_lag_seconds": {"task"},
    }.items():
        there.setdefault(name, frozenset(labels))
    assert len(expressions()) > 40
    for where, expression in expressions():
        names = set(NAME.findall(expression))
        assert names, where
        assert names <= there.keys() | ADDED, f"{where}: {names - there.keys()}"
        assert expression.count("(") == expression.count(")"), where
        labels = {label for name in names for label in there.get(name, ())} | LABELS_ADDED
        used = set(re.findall(r"[{,]\s*(\w+)\s*(?:=~|!~|!=|=)", expression))
        for listed in re.findall(r"\b(?:by|on|without)\s*\(([^)]*)\)", expression):
            used |= {label.strip() for label in listed.split(",") if label.strip()}
        assert used <= labels, f"{where}: {used - labels}"


def test_every_name_begins_with_its_service_and_no_label_is_anyones_choice(
    whole: CollectorRegistry,
) -> None:
    for name, labels in exported(whole).items():
        assert re.match(r"placewise_(gateway|extractor|search|steward)_", name), name
        assert labels <= {
            *("method", "route", "status", "kind", "state", "stage", "outcome", "task"),
            *("certificate", "device", "generation", "le", "reason"),
        }, name


def test_a_gateway_counts_its_calls_by_route(service: Service) -> None:
    file_id = service.indexed(1)[0]
    for _ in range(3):
        service("GET", f"/uploads/{file_id}")
    service("GET", "/nowhere/at-all")
    text = read(service._client.get("/metrics").text)
    requests = text["placewise_gateway_requests_total"]
    route = "/api/v1/uploads/{file_id}"
    assert requests[(("method", "GET"), ("route", route), ("status", "200"))] == 3
    assert requests[(("method", "GET"), ("route", "none"), ("status", "404"))] == 1
    assert not any(file_id in value for labels in requests for _, value in labels)
    received = text["placewise_gateway_received_bytes_total"]
    assert received[(("route", "/api/v1/upload"),)] > len(photo_bytes(1))
    count = text["placewise_gateway_request_seconds_count"]
    assert count[(("method", "GET"), ("route", route))] == 3
    assert text["placewise_gateway_requests_under_way"][()] == 1, "the scrape itself"


@pytest.mark.databases("sqlite", "postgresql")
def test_the_queue_is_counted_by_kind_and_state_with_the_age_of_its_oldest(
    catalog: Catalog,
) -> None:
    with catalog.write() as session:
        map_id = add_map(session).id
        add_job(session, map_id)
        add_job(session, map_id)
        add_job(session, map_id, JobKind.FIT, waiting_for=WaitingFor.DESCRIPTORS)
        add_job(session, map_id, state=JobState.FAILED)
        add_job(session, map_id, state=JobState.SUCCEEDED)
    with catalog.read() as session:
        counted = count_jobs(session)
    assert {(kind, state): count for kind, state, count, _ in counted} == {
        ("index", "queued"): 2,
        ("index", "failed"): 1,
        ("fit", "waiting"): 1,
    }
    assert all(0 <= oldest_seconds < 300 for *_, oldest_seconds in counted)


def test_an_extractor_counts_its_batches_stages_and_losses(averages: Harness) -> None:
    averages.upload(1, 2, 3)
    averages.drain()
    metrics: Any = averages.worker._metrics
    registry = CollectorRegistry()
    registry.register(metrics.batch_jobs)
    registry.register(metrics._jobs)
    registry.register(metrics._stage_seconds)
    registry.register(metrics.model_load_seconds)

    def value(name: str, **labels: str) -> float | None:
        return registry.get_sample_value(name, labels)

    assert value("placewise_extractor_batch_jobs_sum", kind="index") == 3
    assert value("placewise_extractor_jobs_total", kind="index", outcome="succeeded") == 3
    for stage in ("read", "decode", "describe", "features", "publish"):
        assert value("placewise_extractor_stage_seconds_count", stage=stage) == 1, stage
    assert value("placewise_extractor_model_load_seconds_count") == 1


def test_a_steward_counts_its_tasks_and_repairs(
    catalog: Catalog, store: FolderStore, settings: Settings
) -> None:
    registry = CollectorRegistry()
    steward = Scheduler(catalog, store, InProcessWakeups(), settings, StewardMetrics(registry))
    with catalog.write() as session:
        map_id = add_map(session).id
        add_job(session, map_id)
        add_job(session, map_id)
    expire_lease(catalog, take(catalog, 1)[0].id)
    tasks = {task.name: task for task in steward.tasks}
    for name in ("reclaim_leases", "resend_wakeups", "collect_garbage"):
        steward._run_task(tasks[name])
    tasks["merge_small_chunks"].run = lambda: 1 / 0
    steward._run_task(tasks["merge_small_chunks"])
    value = registry.get_sample_value
    assert value("placewise_steward_leases_expired_total") == 1
    assert value("placewise_steward_wakeups_resent_total") == 1
    counted = "placewise_steward_tasks_total"
    assert value(counted, {"task": "reclaim_leases", "outcome": "done"}) == 1
    assert value(counted, {"task": "merge_small_chunks", "outcome": "failed"}) == 1
    assert value("placewise_steward_task_lag_seconds", {"task": "collect_garbage"}) is not None
    assert value("placewise_steward_task_lag_seconds", {"task": "merge_small_chunks"}) is None


def test_figures_are_answered_on_a_port_of_their_own(
    whole: CollectorRegistry, monkeypatch: pytest.MonkeyPatch
) -> None:
    with serve_metrics(Settings(), whole) as none:
        assert none is None
    monkeypatch.setenv("METRICS_PORT", "0")
    with serve_metrics(Settings(), whole) as port:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
            assert b"placewise_gateway_catalog_up 1.0" in answer.read()
        monkeypatch.setenv("METRICS_PORT", str(port))
        with pytest.raises(Misconfigured, match="METRICS_PORT"), serve_metrics(Settings(), whole):
            pass
