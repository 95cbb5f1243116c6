"""The compose files: valid, complete, closed to whoever is not meant to come in."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from services.http_server import SHUTDOWN_GRACE_SECONDS
from tests.deploy.composition import (
    EMBEDDED,
    PROFILES,
    ROOT,
    SERVICES,
    Json,
    make_env,
    read_by_docker,
    seconds,
    services,
    variables,
)

BOTH = pytest.mark.parametrize("file", [SERVICES, EMBEDDED], ids=lambda file: file.name)
REQUIRED = {
    "ADMIN_KEY",
    "FLOWER_PASSWORD",
    "GRAFANA_PASSWORD",
    "POSTGRES_PASSWORD",
    "REDIS_PASSWORD",
    "S3_ACCESS_KEY",
    "S3_SECRET_KEY",
}
OURS = {"gateway", "extractor", "extractor-gpu", "search", "steward"}
ONCE = {"migrate", "create-bucket", "own-objects"}


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("project")
    make_env(folder)
    return folder


@pytest.fixture(scope="module")
def values(project: Path) -> dict[str, str]:
    return variables(project / ".env")


@pytest.fixture(scope="module")
def everything(project: Path, values: dict[str, str]) -> dict[str, Json]:
    return services(SERVICES, project, values)


@pytest.fixture(scope="module")
def all_services(project: Path, everything: dict[str, Json]) -> dict[str, Json]:
    return {**everything, **services(EMBEDDED, project, {})}


@BOTH
def test_file_follows_the_compose_specification(file: Path) -> None:
    command = ["check-jsonschema", "--builtin-schema", "vendor.compose-spec", str(file)]
    program = str(Path(sys.executable).with_name(command[0]))
    done = subprocess.run([program, *command[1:]], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_each_profile_starts_its_services(project: Path, values: dict[str, str]) -> None:
    always = {"gateway", "search", "steward", "postgres", "redis"}
    always |= {"migrate", "create-bucket"}
    more = {
        "cpu": {"extractor"},
        "gpu": {"extractor-gpu"},
        "seaweedfs": {"objects", "own-objects"},
        "flower": {"flower"},
        "milvus": {"milvus"},
        "monitoring": {"prometheus", "grafana"},
    }
    assert set(more) == set(PROFILES)
    without = {**values, "COMPOSE_PROFILES": ""}
    assert set(services(SERVICES, project, without, ())) == always
    for profile, added in more.items():
        assert set(services(SERVICES, project, without, (profile,))) == always | added
    # What `make env` chooses.
    chosen = always | more["cpu"] | more["seaweedfs"] | more["flower"]
    assert set(services(SERVICES, project, values, ())) == chosen


def test_the_embedded_placewise_runs_on_a_gpu_where_its_service_is_named(project: Path) -> None:
    found = services(EMBEDDED, project, {}, ("gpu",))
    assert set(services(EMBEDDED, project, {}, ())) == {"placewise"}
    assert set(found) == {"placewise", "placewise-gpu"}
    gpu = found["placewise-gpu"]
    (device,) = gpu["deploy"]["resources"]["reservations"]["devices"]
    assert (device["driver"], device["capabilities"]) == ("nvidia", ["gpu"])
    assert gpu["environment"] == {**found["placewise"]["environment"], "DEVICE": "cuda"}
    assert gpu["build"]["args"]["TORCH_INDEX"] == ""
    assert gpu["image"] != found["placewise"]["image"]
    # The data stay where they are.
    for shared in ("volumes", "ports", "command"):
        assert gpu[shared] == found["placewise"][shared]


def test_the_documented_service_for_a_second_gpu_reserves_that_gpu_alone(
    tmp_path: Path, values: dict[str, str]
) -> None:
    page = (ROOT / "docs/how-to/docker-compose.md").read_text()
    (example,) = re.findall(r"```yaml\n(services:\n  extractor-gpu-1:.*?)```", page, re.DOTALL)
    shutil.copy(SERVICES, tmp_path)
    override = tmp_path / "docker-compose.override.yml"
    override.write_text(example)
    found = services(tmp_path / SERVICES.name, tmp_path, values, ("gpu",), override)
    reserved = {
        name: found[name]["deploy"]["resources"]["reservations"]["devices"]
        for name in ("extractor-gpu", "extractor-gpu-1")
    }
    device = {"driver": "nvidia", "capabilities": ["gpu"]}
    assert reserved == {
        "extractor-gpu": [{**device, "device_ids": ["0"]}],
        "extractor-gpu-1": [{**device, "device_ids": ["1"]}],
    }
    second = found["extractor-gpu-1"]
    # Prometheus looks extractors up by this name.
    assert set(second["networks"]) == set(found["extractor-gpu"]["networks"])
    assert second["networks"]["inside"]["aliases"] == ["extractor-gpu"]
    for name in ("image", "command", "environment", "volumes", "depends_on", "profiles"):
        assert second[name] == found["extractor-gpu"][name]


@pytest.mark.parametrize("missing", sorted(REQUIRED))
def test_without_a_secret_nothing_starts_and_the_answer_says_what_to_do(
    missing: str, tmp_path: Path, values: dict[str, str]
) -> None:
    for given in ({**values, missing: ""}, {k: v for k, v in values.items() if k != missing}):
        result = read_by_docker(SERVICES, tmp_path, given, (), "-q")
        assert result.returncode != 0
        assert missing in result.stderr
        assert "make env" in result.stderr


def test_make_env_sets_every_secret_anew_and_readable_by_its_user_alone(
    tmp_path: Path, project: Path, values: dict[str, str]
) -> None:
    assert {name for name in REQUIRED if values[name]} == REQUIRED
    other = variables(make_env(tmp_path))
    for name in REQUIRED - {"S3_ACCESS_KEY"}:
        assert len(values[name]) == 40
        assert other[name] != values[name]
    assert (project / ".env").stat().st_mode & 0o077 == 0


def test_make_env_leaves_an_env_that_is_there(project: Path) -> None:
    before = (project / ".env").read_text()
    done = subprocess.run(["make", "env"], cwd=project, capture_output=True, check=False)
    assert done.returncode != 0
    assert (project / ".env").read_text() == before


def test_no_secret_stands_in_the_files() -> None:
    for file in (SERVICES, EMBEDDED):
        for name in REQUIRED:
            assert f"{name}:-" not in file.read_text().replace("${ADMIN_KEY:-}", "")


def test_every_service_runs_without_rights_that_it_does_not_need(
    all_services: dict[str, Json],
) -> None:
    for name, service in all_services.items():
        assert service["read_only"], name
        assert service["cap_drop"] == ["ALL"], name
        assert service["security_opt"] == ["no-new-privileges:true"], name
        assert not service.get("privileged"), name
        limits = service["deploy"]["resources"]["limits"]
        # Docker refuses more processors than the machine has, and decoders need all beside a GPU.
        assert set(limits) == {"memory", "pids"}, name
        if name == "own-objects":
            assert (service["user"], service["cap_add"]) == ("0:0", ["CHOWN"])
            assert service["network_mode"] == "none"
        else:
            # The image of Milvus has files of root, which no right but ownership opens.
            assert (int(service["user"].split(":")[0]) == 0) == (name == "milvus"), name
            assert not service.get("cap_add"), name


def test_every_service_has_a_health_check_or_runs_once(
    all_services: dict[str, Json],
) -> None:
    for name, service in all_services.items():
        check = service["healthcheck"]
        if name in ONCE:
            assert check["disable"], name
            assert service["restart"] == "no"
        else:
            assert check["test"][0] in ("CMD", "CMD-SHELL"), name
            assert service["restart"] == "unless-stopped"


def test_every_image_has_a_fixed_version(all_services: dict[str, Json]) -> None:
    for name, service in all_services.items():
        assert re.search(r":v?\d+\.\d+", service["image"]), name
    for base in re.findall(r"^FROM (\S+)", (ROOT / "deploy/Dockerfile").read_text(), re.MULTILINE):
        assert re.search(r":\d+\.\d+\.\d+-", base), base


def test_each_image_is_built_for_the_command_that_it_runs(all_services: dict[str, Json]) -> None:
    extras = {"placewise": "embedded", "migrate": "gateway", "create-bucket": "gateway"}
    built = {name: s["build"]["args"] for name, s in all_services.items() if "build" in s}
    for name, arguments in built.items():
        service = re.sub(r"-(gpu|\d)$", "", name)
        assert arguments["SERVICE"] == extras.get(service, service)
    assert "/cpu" in built["extractor"]["TORCH_INDEX"]
    assert built["extractor-gpu"]["TORCH_INDEX"] == ""
    assert all_services["extractor"]["image"] != all_services["extractor-gpu"]["image"]


def test_search_urls_name_the_search_worker(everything: dict[str, Json]) -> None:
    url = f"http://search:{everything['search']['environment']['PORT']}"
    for name in ("gateway", "steward"):
        assert everything[name]["environment"]["SEARCH_URLS"] == url


def test_services_wait_until_the_tables_and_the_bucket_are_made(
    everything: dict[str, Json],
) -> None:
    for name in OURS:
        waits = everything[name]["depends_on"]
        for once in ("migrate", "create-bucket"):
            assert waits[once]["condition"] == "service_completed_successfully", name
    assert everything["migrate"]["depends_on"]["postgres"]["condition"] == "service_healthy"
    # Another S3 server may be used, and then this one is not there.
    assert everything["create-bucket"]["depends_on"]["objects"] == {
        "condition": "service_healthy",
        "required": False,
    }


def test_only_the_gateway_flower_and_grafana_listen_to_the_machine_and_only_on_loopback(
    all_services: dict[str, Json],
) -> None:
    open_to = {name: s["ports"] for name, s in all_services.items() if s.get("ports")}
    assert set(open_to) == {"gateway", "flower", "grafana", "placewise", "placewise-gpu"}
    for ports in open_to.values():
        assert {port["host_ip"] for port in ports} == {"127.0.0.1"}


def test_the_servers_are_on_an_internal_network(everything: dict[str, Json]) -> None:
    assert yaml.safe_load(SERVICES.read_text())["networks"]["inside"]["internal"]
    servers = {"postgres", "redis", "objects", "prometheus"}
    assert {n for n, s in everything.items() if set(s.get("networks", {})) == {"inside"}} >= servers
    # S3_ENDPOINT may be elsewhere.
    for name in (*OURS, "create-bucket"):
        assert set(everything[name]["networks"]) == {"inside", "outside"}, name


def test_an_extractor_has_time_to_end_its_batches(everything: dict[str, Json]) -> None:
    for name in ("extractor", "extractor-gpu"):
        assert seconds(everything[name]["stop_grace_period"]) > 60
        # Nor may a batch be taken for a standstill.
        assert float(everything[name]["healthcheck"]["test"][-1]) > 100
    for name in ("gateway", "search"):
        assert seconds(everything[name]["stop_grace_period"]) > 2 * SHUTDOWN_GRACE_SECONDS


def test_redis_persists_and_evicts_nothing(everything: dict[str, Json]) -> None:
    command = " ".join(everything["redis"]["command"])
    assert "--appendonly yes" in command
    assert "--maxmemory-policy noeviction" in command
    # And its password is on no command line.
    password = everything["redis"]["environment"]["REDISCLI_AUTH"]
    assert password
    assert password not in command


def test_another_s3_server_needs_no_change_of_the_file(
    project: Path, values: dict[str, str]
) -> None:
    other = {"COMPOSE_PROFILES": "cpu", "S3_ENDPOINT": "s3.example.com", "S3_SECURE": "true"}
    found = services(SERVICES, project, {**values, **other}, ())
    assert "objects" not in found
    for name in ("gateway", "extractor", "search", "steward", "create-bucket"):
        environment = found[name]["environment"]
        assert environment["S3_ENDPOINT"] == "s3.example.com"
        assert environment["S3_SECURE"] == "true"


def test_container_file_has_no_known_fault() -> None:
    hadolint = Path(sys.executable).with_name("hadolint")
    done = subprocess.run(
        [hadolint, ROOT / "deploy/Dockerfile"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout
