"""Prometheus' and Grafana's files: well formed, complete, closed to whoever has no password."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.deploy.composition import ROOT, SERVICES, make_env, services, variables

PROMETHEUS = ROOT / "deploy" / "prometheus"
GRAFANA = ROOT / "deploy" / "grafana"
DASHBOARDS = sorted((GRAFANA / "dashboards").glob("*.json"))


@pytest.fixture(scope="module")
def everything(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("project")
    return services(SERVICES, folder, variables(make_env(folder)))


def test_every_process_of_the_compose_file_is_scraped_on_its_port(
    everything: dict[str, Any],
) -> None:
    config = yaml.safe_load((PROMETHEUS / "prometheus.yml").read_text())
    assert config["rule_files"] == ["alerts.yml"]
    searched = {}
    for job in config["scrape_configs"]:
        for found in job.get("dns_sd_configs", []):
            for name in found["names"]:
                searched[name] = (job["job_name"], found["port"])
    measured = {n: s for n, s in everything.items() if "METRICS_PORT" in s.get("environment", {})}
    assert set(searched) == set(measured)
    for name, (job, port) in searched.items():
        environment = measured[name]["environment"]
        assert environment["METRICS_PORT"] == str(port)
        assert environment["HOST"] == "0.0.0.0"
        assert job == f"placewise-{name.partition('-')[0]}"
        assert not any(p["target"] == port for p in measured[name].get("ports", []))
        assert "inside" in measured[name]["networks"]


def test_every_alert_says_how_bad_it_is_what_it_means_and_where_to_begin() -> None:
    (group,) = yaml.safe_load((PROMETHEUS / "alerts.yml").read_text())["groups"]
    names = [rule["alert"] for rule in group["rules"]]
    assert len(set(names)) == len(names)
    for rule in group["rules"]:
        assert set(rule) <= {"alert", "expr", "for", "labels", "annotations"}, rule["alert"]
        assert rule["labels"]["severity"] in ("warning", "critical")
        assert set(rule["annotations"]) == {"summary", "runbook"}
        assert re.fullmatch(r"\d+[smh]", rule.get("for", "1m"))
        for placeholder in re.findall(r"{{(.*?)}}", rule["annotations"]["summary"]):
            assert re.match(r" \$(value|labels\.\w+)( \| humaniz\w+)? $", placeholder)
    (down,) = (rule["expr"] for rule in group["rules"] if rule["alert"] == "PlacewiseDown")
    scraped = yaml.safe_load((PROMETHEUS / "prometheus.yml").read_text())["scrape_configs"]
    always = {job["job_name"] for job in scraped} - {"placewise-extractor", "prometheus"}
    assert set(re.findall(r'absent\(up{job="(.*?)"}\)', down)) == always
    runbook = (ROOT / "docs/how-to/runbook.md").read_text()
    assert re.findall(r"^## (.+)$", runbook, re.MULTILINE) == names


@pytest.mark.parametrize("file", DASHBOARDS, ids=lambda file: file.stem)
def test_a_dashboard_can_be_provisioned(file: Path) -> None:
    board = json.loads(file.read_text())
    assert board["uid"] == f"placewise-{file.stem}"
    source = yaml.safe_load((GRAFANA / "provisioning/datasources/prometheus.yml").read_text())
    uid = source["datasources"][0]["uid"]
    ids = [panel["id"] for panel in board["panels"]]
    assert len(set(ids)) == len(ids)
    taken: set[tuple[int, int]] = set()
    for panel in board["panels"]:
        assert panel["datasource"]["uid"] == uid
        assert panel["title"]
        at = panel["gridPos"]
        cells = {
            (x, y)
            for x in range(at["x"], at["x"] + at["w"])
            for y in range(at["y"], at["y"] + at["h"])
        }
        assert at["x"] + at["w"] <= 24
        assert not cells & taken, f"{panel['title']} lies over another panel"
        taken |= cells
        assert len({target["refId"] for target in panel["targets"]}) == len(panel["targets"])


def test_the_dashboards_that_are_described_are_there(everything: dict[str, Any]) -> None:
    assert [file.stem for file in DASHBOARDS] == ["extractor", "jobs", "overview", "search"]
    provider = yaml.safe_load((GRAFANA / "provisioning/dashboards/placewise.yml").read_text())
    path = provider["providers"][0]["options"]["path"]
    mounts = {m["target"]: m for m in everything["grafana"]["volumes"] if m["type"] == "bind"}
    assert mounts[path]["source"].endswith("deploy/grafana/dashboards")
    home = everything["grafana"]["environment"]["GF_DASHBOARDS_DEFAULT_HOME_DASHBOARD_PATH"]
    assert home == f"{path}/overview.json"
    assert all(mount["read_only"] for mount in mounts.values())


def test_grafana_lets_nobody_in_without_the_password(everything: dict[str, Any]) -> None:
    environment = everything["grafana"]["environment"]
    assert len(environment["GF_SECURITY_ADMIN_PASSWORD"]) == 40
    assert environment["GF_AUTH_ANONYMOUS_ENABLED"] == "false"
    assert environment["GF_USERS_ALLOW_SIGN_UP"] == "false"
