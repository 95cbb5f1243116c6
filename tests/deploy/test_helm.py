"""The Helm chart: what it makes of its example values, and the query that scales extractors."""

from __future__ import annotations

import json
import re
from collections import Counter
from pathlib import Path

import kubernetes_validate
import pytest
import yaml
from sqlalchemy import text, update

from services.http_server import SHUTDOWN_GRACE_SECONDS
from shared.catalog.database.session import Catalog
from shared.catalog.jobs import EXTRACTOR_JOBS, JobKind, WaitingFor
from shared.config.settings import SECRET_SETTINGS, Settings
from shared.jobs import Job, JobState
from tests.deploy.composition import ROOT, SERVICES, services
from tests.deploy.helm_chart import (
    CHART,
    EXAMPLES,
    RELEASE,
    Json,
    example,
    helm_of_example,
    parse_manifests,
    run_helm,
)
from tests.support.catalog_rows import add_map

EACH = pytest.mark.parametrize("name", EXAMPLES)
# Of KEDA, the Prometheus Operator and the External Secrets Operator: no schemas are at hand.
CUSTOM = {
    "ScaledObject",
    "TriggerAuthentication",
    "PodMonitor",
    "PrometheusRule",
    "ExternalSecret",
}
SERVING = ("Deployment", "StatefulSet")
WORKLOADS = (*SERVING, "Job", "CronJob")


def manifests(name: str) -> tuple[Json, ...]:
    return parse_manifests(helm_of_example(name))


def of_kind(name: str, *kinds: str) -> list[Json]:
    return [one for one in manifests(name) if one["kind"] in kinds]


def component(manifest: Json) -> str:
    """`gateway`, `search`, `migrate`: of the labels, not of the name."""
    part: str = manifest["metadata"]["labels"]["app.kubernetes.io/component"]
    return part


def by_component(name: str, *kinds: str) -> dict[str, Json]:
    found = of_kind(name, *kinds)
    result = {component(one): one for one in found}
    assert len(result) == len(found)
    return result


def pod(workload: Json) -> Json:
    spec = workload["spec"]
    if workload["kind"] == "CronJob":
        spec = spec["jobTemplate"]["spec"]
    found: Json = spec["template"]
    return found


def container(workload: Json) -> Json:
    (only,) = pod(workload)["spec"]["containers"]
    found: Json = only
    return found


def variables(workload: Json) -> dict[str, Json]:
    return {variable["name"]: variable for variable in container(workload)["env"]}


def settings_of(name: str) -> dict[str, str]:
    (found,) = (one for one in of_kind(name, "ConfigMap") if component(one) == "settings")
    data: dict[str, str] = found["data"]
    return data


@EACH
def test_helm_finds_no_fault_in_the_chart(name: str) -> None:
    lint = helm_of_example(name)["lint"]
    assert lint["errors"] == []
    # 1 is information: that a chart may have an icon.
    assert [message for message in lint["messages"] if message["severity"] > 1] == []


@EACH
def test_every_manifest_follows_its_schema_and_has_a_name_of_its_own(name: str) -> None:
    for manifest in manifests(name):
        if manifest["kind"] not in CUSTOM:
            kubernetes_validate.validate(manifest, "1.37", strict=True)
    names = Counter((one["kind"], one["metadata"]["name"]) for one in manifests(name))
    assert set(names.values()) == {1}


def test_the_examples_have_every_kind_of_resource() -> None:
    kinds = {one["kind"] for name in EXAMPLES for one in manifests(name)}
    assert kinds >= {*CUSTOM, *WORKLOADS, "Ingress", "PersistentVolumeClaim", "NetworkPolicy"}


def test_the_schema_knows_every_value_and_refuses_others() -> None:
    values = yaml.safe_load((CHART / "values.yaml").read_text())
    schema = json.loads((CHART / "values.schema.json").read_text())
    assert set(values) | {"global"} == set(schema["properties"])
    base = example("cpu")
    for wrong in (
        {"extractor": {"devise": "cuda"}},
        {"ingres": {"enabled": True}},
        {"settings": {**base["settings"], "ADMIN_KEY": "0123456789abcdef"}},
    ):
        assert "schema" in run_helm({**base, **wrong})["error"]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"settings": {}}, "S3_ENDPOINT"),
        ({"ingress": {"enabled": True}}, "ingress.host"),
        (
            {"ingress": {"enabled": True, "host": "a.example.com", "tls": {"secretName": ""}}},
            "ingress.tls.secretName",
        ),
        ({"monitoring": {"enabled": True}}, "monitoring.runbookUrl"),
        ({"secrets": {"externalSecret": {"enabled": True}}}, "externalSecret.store.name"),
    ],
)
def test_a_value_that_is_needed_is_named_when_it_is_missing(change: Json, named: str) -> None:
    error = run_helm({**example("cpu"), **change})["error"]
    assert f"{named} is required" in error


@EACH
def test_every_pod_runs_without_rights_that_it_does_not_need(name: str) -> None:
    for workload in of_kind(name, *WORKLOADS):
        spec = pod(workload)["spec"]
        assert spec["securityContext"]["runAsNonRoot"]
        assert spec["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
        assert spec["automountServiceAccountToken"] is False
        assert container(workload)["securityContext"] == {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        }
        assert {"requests", "limits"} <= set(container(workload)["resources"])
        assert re.search(r":\d+\.\d+\.\d+(-\w+)?$", container(workload)["image"])


@EACH
def test_every_service_is_watched_spread_and_has_time_to_end(name: str) -> None:
    found = by_component(name, *SERVING)
    for workload in found.values():
        assert {"startupProbe", "livenessProbe"} <= set(container(workload))
        spec = pod(workload)["spec"]
        grace = spec["terminationGracePeriodSeconds"]
        if container(workload).get("ports"):
            assert "readinessProbe" in container(workload)
            _, waited = container(workload)["lifecycle"]["preStop"]["exec"]["command"]
            assert grace > int(waited) + 2 * SHUTDOWN_GRACE_SECONDS
        keys = [rule["topologyKey"] for rule in spec["topologySpreadConstraints"]]
        assert keys == ["kubernetes.io/hostname", "topology.kubernetes.io/zone"]
        for rule in spec["topologySpreadConstraints"]:
            assert rule["labelSelector"] == workload["spec"]["selector"]
    grace = pod(found["extractor"])["spec"]["terminationGracePeriodSeconds"]
    assert grace > 60
    (scaled,) = of_kind(name, "ScaledObject")
    assert scaled["spec"]["cooldownPeriod"] > grace


def test_checks_and_commands_are_those_of_the_compose_file(tmp_path: Path) -> None:
    passwords = (f"{name}_PASSWORD" for name in ("POSTGRES", "REDIS", "FLOWER", "GRAFANA"))
    secrets = (*passwords, "ADMIN_KEY")
    values = dict.fromkeys((*secrets, "S3_ACCESS_KEY", "S3_SECRET_KEY"), "x")
    compose = services(SERVICES, tmp_path, values)
    for name, workload in by_component("cpu", *WORKLOADS).items():
        assert container(workload)["args"] == compose[name]["command"]
        if name in ("extractor", "steward"):
            test = compose[name]["healthcheck"]["test"][1:]
            assert container(workload)["livenessProbe"]["exec"]["command"] == test


@EACH
def test_no_manifest_holds_a_secret_and_each_pod_gets_only_its_own(name: str) -> None:
    assert not of_kind(name, "Secret")
    catalog, objects = {"DATABASE_URL"}, {"S3_ACCESS_KEY", "S3_SECRET_KEY"}
    expected = {
        "gateway": catalog | objects | {"REDIS_URL", "ADMIN_KEY"},
        "extractor": catalog | objects | {"REDIS_URL"},
        "steward": catalog | objects | {"REDIS_URL"},
        "search": catalog | objects,
        "backup": catalog | objects,
        "migrate": catalog,
        "create-bucket": objects,
    }
    as_files = example(name).get("secrets", {}).get("asFiles", False)
    for part, workload in by_component(name, *WORKLOADS).items():
        names = expected[part] | ({"MILVUS_URI"} if (name, part) == ("milvus", "search") else set())
        assert names <= set(SECRET_SETTINGS)
        volumes = {one["name"]: one for one in pod(workload)["spec"]["volumes"]}
        if as_files:
            mounts = {one["name"]: one["mountPath"] for one in container(workload)["volumeMounts"]}
            items = {item["key"]: item["path"] for item in volumes["secrets"]["secret"]["items"]}
            assert set(items) == names
            for secret in names:
                path = f"{mounts['secrets']}/{items[secret]}"
                assert variables(workload)[f"{secret}_FILE"]["value"] == path
        else:
            given = {n for n, variable in variables(workload).items() if "valueFrom" in variable}
            assert given == names
            assert "secrets" not in volumes
    settings = settings_of(name)
    assert all(setting.lower() in Settings.model_fields for setting in settings)
    assert not set(settings) & set(SECRET_SETTINGS)


def test_a_steward_with_an_immich_library_has_what_that_of_the_compose_file_has() -> None:
    compose = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]["steward"]
    names = {n for n in compose["environment"] if n.startswith(("IMMICH_", "PLACEWISE_"))}
    given = variables(by_component("production", "Deployment")["steward"])
    assert len(names) == 5
    assert names <= set(given)
    assert not names & set(variables(by_component("cpu", "Deployment")["steward"]))
    keys = [
        given[name]["valueFrom"]["secretKeyRef"] for name in ("IMMICH_API_KEY", "PLACEWISE_KEY")
    ]
    assert [key["key"] for key in keys] == ["IMMICH_API_KEY", "ADMIN_KEY"]
    gateway = by_component("production", "Service")["gateway"]
    assert gateway["spec"]["ports"][0]["port"] == 80
    assert given["PLACEWISE_SERVER"]["value"] == f"http://{gateway['metadata']['name']}"
    (policy,) = (
        one["spec"]
        for one in of_kind("production", "NetworkPolicy")
        if one["metadata"]["name"] == f"{RELEASE}-search-clients"
    )
    selector = policy["egress"][-1]["to"][0]["podSelector"]["matchLabels"]
    assert selector == gateway["spec"]["selector"]


def test_an_external_store_fills_the_secret_that_the_pods_read() -> None:
    (external,) = of_kind("production", "ExternalSecret")
    secret = external["spec"]["target"]["name"]
    assert secret == "placewise-settings"
    for workload in of_kind("production", *WORKLOADS):
        volumes = {one["name"]: one for one in pod(workload)["spec"]["volumes"]}
        assert volumes["secrets"]["secret"]["secretName"] == secret
    (trigger,) = of_kind("production", "TriggerAuthentication")
    assert trigger["spec"]["secretTargetRef"][0]["name"] == secret


@EACH
def test_search_urls_name_every_worker_that_autoscaling_may_start(name: str) -> None:
    workers = of_kind(name, "StatefulSet")
    scaled = by_component(name, "HorizontalPodAutoscaler")
    urls = {
        f"http://{worker['metadata']['name']}-{number}.{worker['spec']['serviceName']}:8000"
        for worker in workers
        for number in range(scaled[component(worker)]["spec"]["maxReplicas"])
    }
    for worker in workers:
        (service,) = (
            one
            for one in of_kind(name, "Service")
            if one["metadata"]["name"] == worker["spec"]["serviceName"]
        )
        assert service["spec"]["clusterIP"] == "None"
    assert set(settings_of(name)["SEARCH_URLS"].split(",")) == urls
    assert len(workers) == 1


@EACH
def test_label_selectors_match_the_intended_pods(name: str) -> None:
    pods = {
        part: pod(workload)["metadata"]["labels"]
        for part, workload in by_component(name, *WORKLOADS).items()
    }

    def selected(selector: Json) -> set[str]:
        labels = selector.get("matchLabels", {})
        expressions = selector.get("matchExpressions", [])
        return {
            part
            for part, has in pods.items()
            if labels.items() <= has.items()
            and all(has.get(one["key"]) in one["values"] for one in expressions)
        }

    for part, service in by_component(name, "Service").items():
        assert selected({"matchLabels": service["spec"]["selector"]}) == {part}
    for part, budget in by_component(name, "PodDisruptionBudget").items():
        assert selected(budget["spec"]["selector"]) == {part}
    for part, workload in by_component(name, *SERVING).items():
        assert selected(workload["spec"]["selector"]) == {part}
    policies = {one["metadata"]["name"]: one["spec"] for one in of_kind(name, "NetworkPolicy")}
    everyone = policies[RELEASE]
    assert selected(everyone["podSelector"]) == set(pods)
    assert everyone["policyTypes"] == ["Ingress", "Egress"]
    assert "ingress" not in everyone
    searching = {part for part in pods if part.startswith("search")}
    assert selected(policies[f"{RELEASE}-gateway"]["podSelector"]) == {"gateway"}
    assert selected(policies[f"{RELEASE}-search"]["podSelector"]) == searching
    assert selected(policies[f"{RELEASE}-search-clients"]["podSelector"]) == {"gateway", "steward"}
    (rule,) = policies[f"{RELEASE}-search"]["ingress"]
    assert selected(rule["from"][0]["podSelector"]) == {"gateway", "steward"}


@EACH
def test_each_workload_has_one_that_scales_it_at_most(name: str) -> None:
    scaled = Counter(
        one["spec"]["scaleTargetRef"]["name"]
        for one in of_kind(name, "HorizontalPodAutoscaler", "ScaledObject")
    )
    assert set(scaled.values()) == {1}
    for workload in of_kind(name, *SERVING):
        by_itself = "replicas" not in workload["spec"]
        assert by_itself == (workload["metadata"]["name"] in scaled)
        assert by_itself == (component(workload) != "steward")


def test_gpu_extractor_takes_one_gpu_and_keeps_its_weights() -> None:
    extractor = by_component("gpu", "Deployment")["extractor"]
    assert container(extractor)["resources"]["limits"] == {"memory": "16Gi", "nvidia.com/gpu": 1}
    assert variables(extractor)["DEVICE"]["value"] == "cuda"
    assert container(extractor)["image"].endswith("-cuda")
    assert pod(extractor)["spec"]["tolerations"][0]["key"] == "nvidia.com/gpu"
    volumes = {one["name"]: one for one in pod(extractor)["spec"]["volumes"]}
    claim = volumes["weights"]["persistentVolumeClaim"]["claimName"]
    (weights,) = of_kind("gpu", "PersistentVolumeClaim")
    assert weights["metadata"]["name"] == claim
    # KEDA may start a second extractor on another node.
    assert weights["spec"]["accessModes"] == ["ReadWriteMany"]


def jobs_with(change: Json, release: str = RELEASE) -> dict[str, Json]:
    found = parse_manifests(run_helm({**example("cpu"), **change}, release))
    return {one["metadata"]["name"]: one for one in found if one["kind"] == "Job"}


def test_jobs_can_be_applied_twice_and_run_again_for_another_release() -> None:
    first = jobs_with({})
    assert jobs_with({}) == first
    assert len(first) == 2
    # A Job is immutable: what changes it changes its name.
    for change in (
        {"image": {"tag": "0.2.0"}},
        {"settings": {"S3_ENDPOINT": "other.example.com"}},
        {"jobs": {"resources": {"requests": {"cpu": "1"}, "limits": {"memory": "1Gi"}}}},
    ):
        assert not set(jobs_with(change)) & set(first)
    long = jobs_with({}, release="a" * 53)
    assert all(len(job) <= 63 for job in long)


def test_a_changed_setting_replaces_the_pods_that_read_it() -> None:
    def checksums(values: Json) -> dict[str, str]:
        return {
            component(one): pod(one)["metadata"]["annotations"]["checksum/settings"]
            for one in parse_manifests(run_helm(values))
            if one["kind"] in SERVING
        }

    before = checksums(example("cpu"))
    after = checksums({"settings": {**example("cpu")["settings"], "BATCH_PHOTOS": 16}})
    assert all(before[part] != after[part] for part in before)


def test_numbers_and_switches_reach_the_settings_as_they_are_written() -> None:
    settings = {**example("cpu")["settings"], "MAX_FILE_SIZE": 250_000_000, "S3_SECURE": False}
    found = parse_manifests(run_helm({"settings": {**settings, "CERTAINTY": 0.9, "DEBUG": "yes"}}))
    (config,) = (one["data"] for one in found if one["kind"] == "ConfigMap")
    names = ("MAX_FILE_SIZE", "S3_SECURE", "CERTAINTY", "DEBUG")
    assert [config[name] for name in names] == ["250000000", "false", "0.9", "yes"]


def test_backups_go_to_a_volume_that_outlives_the_release() -> None:
    (backup,) = of_kind("production", "CronJob")
    assert backup["spec"]["concurrencyPolicy"] == "Forbid"
    *command, folder = container(backup)["args"]
    assert command == ["placewise", "storage", "backup"]
    mounts = {one["name"]: one["mountPath"] for one in container(backup)["volumeMounts"]}
    assert folder.startswith(mounts["backups"])
    volumes = {one["name"]: one for one in pod(backup)["spec"]["volumes"]}
    claim = volumes["backups"]["persistentVolumeClaim"]["claimName"]
    (volume_claim,) = (
        one
        for one in of_kind("production", "PersistentVolumeClaim")
        if one["metadata"]["name"] == claim
    )
    assert volume_claim["metadata"]["annotations"]["helm.sh/resource-policy"] == "keep"


def test_a_restore_runs_the_backup_job_with_another_command_and_no_service() -> None:
    """As docs/how-to/kubernetes.md has it: two templates, and the second argument."""
    files = helm_of_example("production")["files"]
    texts = [files[f"placewise/templates/{name}.yaml"] for name in ("settings", "backup")]
    made = [one for text in texts for one in yaml.safe_load_all(text) if one]
    (job,) = [one for one in made if one["kind"] == "CronJob"]
    names = {(one["kind"], one["metadata"]["name"]) for one in made}
    assert job["metadata"]["name"] == "placewise-backup"
    pod = job["spec"]["jobTemplate"]["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    assert container["args"] == ["placewise", "storage", "backup", "/backups/placewise"]
    assert ("ConfigMap", container["envFrom"][0]["configMapRef"]["name"]) in names
    (claim,) = [v["persistentVolumeClaim"] for v in pod["volumes"] if "persistentVolumeClaim" in v]
    assert ("PersistentVolumeClaim", claim["claimName"]) in names
    kinds = {"CronJob", "PersistentVolumeClaim", "ConfigMap", "ExternalSecret"}
    assert {kind for kind, _ in names} == kinds, "no service is started"


def test_the_page_is_reached_over_tls() -> None:
    (ingress,) = of_kind("production", "Ingress")
    (rule,) = ingress["spec"]["rules"]
    assert ingress["spec"]["tls"] == [{"hosts": [rule["host"]], "secretName": "placewise-tls"}]
    backend = rule["http"]["paths"][0]["backend"]["service"]
    gateway = by_component("production", "Service")["gateway"]
    assert backend["name"] == gateway["metadata"]["name"]
    assert backend["port"]["name"] == gateway["spec"]["ports"][0]["name"]


def test_the_prometheus_operator_gets_every_alert_with_its_page_of_the_runbook() -> None:
    (rule,) = of_kind("production", "PrometheusRule")
    expected = yaml.safe_load((ROOT / "deploy/prometheus/alerts.yml").read_text())
    base = example("production")["monitoring"]["runbookUrl"]
    (group,) = rule["spec"]["groups"]
    for alert in group["rules"]:
        url = alert["annotations"].pop("runbook_url")
        assert url == f"{base}#{alert['alert'].lower()}"
    assert rule["spec"] == expected


def test_grafana_gets_every_dashboard_as_it_is() -> None:
    boards = {
        file: json.loads(content)
        for one in of_kind("production", "ConfigMap")
        if one["metadata"]["labels"].get("grafana_dashboard") == "1"
        for file, content in one["data"].items()
    }
    folder = ROOT / "deploy/grafana/dashboards"
    assert boards == {path.name: json.loads(path.read_text()) for path in folder.glob("*.json")}


def test_only_prometheus_reaches_the_port_of_the_metrics() -> None:
    (monitor,) = of_kind("production", "PodMonitor")
    (endpoint,) = monitor["spec"]["podMetricsEndpoints"]
    port = endpoint["portNumber"]
    assert settings_of("production")["METRICS_PORT"] == str(port)
    policies = {
        one["metadata"]["name"]: one["spec"] for one in of_kind("production", "NetworkPolicy")
    }
    (rule,) = policies[f"{RELEASE}-metrics"]["ingress"]
    assert rule["ports"] == [{"protocol": "TCP", "port": port}]
    assert rule["from"] == [
        {"namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": "monitoring"}}}
    ]
    (chosen,) = monitor["spec"]["selector"]["matchExpressions"]
    assert set(chosen["values"]) == {"gateway", "extractor", "search", "steward"}


@pytest.mark.databases("postgresql")
def test_extractors_are_scaled_by_the_jobs_that_wait_for_them_or_are_under_way(
    catalog: Catalog,
) -> None:
    (scaled,) = of_kind("cpu", "ScaledObject")
    (trigger,) = scaled["spec"]["triggers"]
    assert trigger["type"] == "postgresql"
    reference = trigger["authenticationRef"]["name"]
    (authentication,) = of_kind("cpu", "TriggerAuthentication")
    assert reference == authentication["metadata"]["name"]

    def counted() -> int:
        with catalog.read() as session:
            return int(session.execute(text(trigger["metadata"]["query"])).scalar_one())

    assert counted() == 0
    with catalog.write() as session:
        map_id = add_map(session, "default", "test-tiny-avg").id
        for kind in JobKind:
            for state in JobState:
                session.add(Job(map_id=map_id, kind=kind, state=state, priority=1))
            waits = {"state": JobState.QUEUED, "waiting_for": WaitingFor.DESCRIPTORS}
            session.add(Job(map_id=map_id, kind=kind, priority=1, **waits))
    assert counted() == 2 * len(EXTRACTOR_JOBS)  # queued and running
    with catalog.write() as session:
        session.execute(update(Job).values(state=JobState.SUCCEEDED))
    assert counted() == 0
