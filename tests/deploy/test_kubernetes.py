"""The Kubernetes manifests as kustomize builds them, and the query that scales extractors."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml
from sqlalchemy import text, update

from services.http_server import SHUTDOWN_GRACE_SECONDS
from shared.catalog.database.session import Catalog
from shared.catalog.jobs import EXTRACTOR_JOBS, STEWARD_JOBS, WaitingFor
from shared.config.settings import Settings
from shared.jobs import Job, JobState
from tests.deploy.composition import ROOT, SERVICES, services
from tests.support.catalog_rows import add_map
from tests.support.servers import PostgresServer

Json = dict[str, Any]
FOLDER = ROOT / "deploy" / "k8s"
BUILDS = ("base", "overlays/cpu", "overlays/gpu")
EACH = pytest.mark.parametrize("build", BUILDS)
# Of KEDA, for which there is no schema here.
CUSTOM = {"ScaledObject", "TriggerAuthentication"}
WORKLOADS = {"Deployment", "StatefulSet", "Job"}


@cache
def built(build: str) -> tuple[Json, ...]:
    kubectl = Path(sys.executable).with_name("kubectl")
    done = subprocess.run(
        [kubectl, "kustomize", FOLDER / build], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == "", "a warning of kustomize"
    return tuple(yaml.safe_load_all(done.stdout))


def of_kind(build: str, *kinds: str) -> dict[str, Json]:
    return {one["metadata"]["name"]: one for one in built(build) if one["kind"] in kinds}


def container(workload: Json) -> Json:
    (only,) = workload["spec"]["template"]["spec"]["containers"]
    found: Json = only
    return found


def variables(workload: Json) -> dict[str, Json]:
    return {variable["name"]: variable for variable in container(workload).get("env", [])}


@EACH
def test_every_manifest_follows_its_schema(build: str) -> None:
    for manifest in built(build):
        if manifest["kind"] not in CUSTOM:
            kubernetes_validate.validate(manifest, "1.37", strict=True)
    assert {one["kind"] for one in built(build)} > CUSTOM | WORKLOADS


@EACH
def test_every_pod_runs_without_rights_that_it_does_not_need(build: str) -> None:
    for name, workload in of_kind(build, *WORKLOADS).items():
        pod = workload["spec"]["template"]["spec"]
        assert pod["securityContext"]["runAsNonRoot"], name
        assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
        assert pod["automountServiceAccountToken"] is False
        assert container(workload)["securityContext"] == {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        }
        assert {"requests", "limits"} <= set(container(workload)["resources"]), name
        assert container(workload)["image"].count(":") == 1, "a fixed version"


@EACH
def test_every_service_is_watched_and_has_time_to_end(build: str) -> None:
    for name, workload in of_kind(build, "Deployment", "StatefulSet").items():
        assert {"startupProbe", "livenessProbe"} <= set(container(workload)), name
        grace = workload["spec"]["template"]["spec"]["terminationGracePeriodSeconds"]
        if container(workload).get("ports"):
            assert "readinessProbe" in container(workload)
            _, waited = container(workload)["lifecycle"]["preStop"]["exec"]["command"]
            assert grace > int(waited) + 2 * SHUTDOWN_GRACE_SECONDS
    extractor = of_kind(build, "Deployment")["extractor"]["spec"]["template"]["spec"]
    (config,) = of_kind(build, "ConfigMap").values()
    drain_seconds = float(config["data"]["DRAIN_SECONDS"])
    assert extractor["terminationGracePeriodSeconds"] > drain_seconds + 60
    scaled = of_kind(build, "ScaledObject")["extractor"]["spec"]
    assert scaled["cooldownPeriod"] > extractor["terminationGracePeriodSeconds"]


def test_checks_and_commands_are_those_of_the_compose_file(tmp_path: Path) -> None:
    passwords = (f"{name}_PASSWORD" for name in ("POSTGRES", "REDIS", "FLOWER", "GRAFANA"))
    secrets = (*passwords, "ADMIN_KEY")
    values = dict.fromkeys((*secrets, "S3_ACCESS_KEY", "S3_SECRET_KEY"), "x")
    compose = services(SERVICES, tmp_path, values)
    for name, workload in of_kind("base", *WORKLOADS).items():
        assert container(workload)["args"] == compose[name]["command"]
        if name in ("extractor", "steward"):
            test = compose[name]["healthcheck"]["test"][1:]
            assert container(workload)["livenessProbe"]["exec"]["command"] == test


@EACH
def test_no_manifest_holds_a_secret_and_each_service_gets_only_its_own(build: str) -> None:
    assert not of_kind(build, "Secret")
    catalog, objects = {"DATABASE_URL"}, {"S3_ACCESS_KEY", "S3_SECRET_KEY"}
    params = {
        "gateway": catalog | objects | {"REDIS_URL", "ADMIN_KEY"},
        "extractor": catalog | objects | {"REDIS_URL"},
        "steward": catalog | objects | {"REDIS_URL"},
        "search-0": catalog | objects,
        "search-1": catalog | objects,
        "migrate": catalog,
        "create-bucket": objects,
    }
    for name, workload in of_kind(build, *WORKLOADS).items():
        secret = {n for n, variable in variables(workload).items() if "valueFrom" in variable}
        assert secret == params[name], name
    (config,) = of_kind(build, "ConfigMap").values()
    assert all(name.lower() in Settings.model_fields for name in config["data"])
    assert not {name for name in config["data"] if "KEY" in name or "PASSWORD" in name}


@EACH
def test_whoever_asks_search_knows_every_worker_that_may_be_there(build: str) -> None:
    workers = of_kind(build, "StatefulSet")
    (config,) = of_kind(build, "ConfigMap").values()
    scaled = of_kind(build, "HorizontalPodAutoscaler")
    urls = {
        f"http://{name}-{number}.{worker['spec']['serviceName']}:8000"
        for name, worker in workers.items()
        for number in range(scaled[name]["spec"]["maxReplicas"])
    }
    for worker in workers.values():
        service = of_kind(build, "Service")[worker["spec"]["serviceName"]]
        assert service["spec"]["clusterIP"] == "None"
    assert set(config["data"]["SEARCH_URLS"].split(",")) == urls
    shards = {variables(worker)["SEARCH_SHARD"]["value"] for worker in workers.values()}
    assert shards == {f"{number}/{len(workers)}" for number in range(len(workers))}


@EACH
def test_what_selects_pods_selects_those_that_it_means(build: str) -> None:
    pods = {
        name: workload["spec"]["template"]["metadata"]["labels"]
        for name, workload in of_kind(build, *WORKLOADS).items()
    }

    def selected(labels: Json) -> set[str]:
        return {name for name, has in pods.items() if labels.items() <= has.items()}

    for name, service in of_kind(build, "Service").items():
        assert selected(service["spec"]["selector"]) == {name}
    for name, budget in of_kind(build, "PodDisruptionBudget").items():
        assert selected(budget["spec"]["selector"]["matchLabels"]) == {name}
    for name, workload in of_kind(build, "Deployment", "StatefulSet").items():
        assert selected(workload["spec"]["selector"]["matchLabels"]) == {name}
    policies = of_kind(build, "NetworkPolicy")
    everyone = policies["placewise"]["spec"]
    assert selected(everyone["podSelector"]["matchLabels"]) == set(pods)
    assert everyone["policyTypes"] == ["Ingress", "Egress"]
    assert "ingress" not in everyone
    for policy in policies.values():
        for expression in policy["spec"]["podSelector"].get("matchExpressions", []):
            known = {labels["app.kubernetes.io/component"] for labels in pods.values()}
            assert set(expression["values"]) <= known


@EACH
def test_each_workload_has_one_that_scales_it_at_most(build: str) -> None:
    scaled = Counter(
        one["spec"]["scaleTargetRef"]["name"]
        for one in built(build)
        if one["kind"] in ("HorizontalPodAutoscaler", "ScaledObject")
    )
    assert scaled == Counter(["gateway", "search-0", "search-1", "extractor"])
    for name, workload in of_kind(build, "Deployment", "StatefulSet").items():
        assert ("replicas" in workload["spec"]) == (name == "steward"), name


def test_gpu_extractor_takes_one_gpu_and_says_so() -> None:
    extractor = of_kind("overlays/gpu", "Deployment")["extractor"]
    assert container(extractor)["resources"]["limits"]["nvidia.com/gpu"] == 1
    assert variables(extractor)["DEVICE"]["value"] == "cuda"
    assert container(extractor)["image"].endswith("-cuda")


@pytest.fixture
def on_postgres(postgres: PostgresServer, migrated_postgres: str) -> Iterator[Catalog]:
    opened = Catalog(postgres.new_database(migrated_postgres))
    yield opened
    opened.close()


def test_extractors_are_scaled_by_the_jobs_that_wait_for_them_or_are_under_way(
    on_postgres: Catalog,
) -> None:
    (trigger,) = of_kind("base", "ScaledObject")["extractor"]["spec"]["triggers"]
    assert trigger["type"] == "postgresql"
    reference = trigger["authenticationRef"]["name"]
    assert reference in of_kind("base", "TriggerAuthentication")

    def counted() -> int:
        with on_postgres.read() as session:
            return int(session.execute(text(trigger["metadata"]["query"])).scalar_one())

    assert counted() == 0
    with on_postgres.write() as session:
        map_id = add_map(session, "default", "test-tiny-avg").id
        for kind in (*EXTRACTOR_JOBS, *STEWARD_JOBS):
            for state in JobState:
                session.add(Job(map_id=map_id, kind=kind, state=state, priority=1))
            waits = {"state": JobState.QUEUED, "waiting_for": WaitingFor.VOCABULARY}
            session.add(Job(map_id=map_id, kind=kind, priority=1, **waits))
    assert counted() == 2 * len(EXTRACTOR_JOBS)  # queued and running
    with on_postgres.write() as session:
        session.execute(update(Job).values(state=JobState.SUCCEEDED))
    assert counted() == 0
