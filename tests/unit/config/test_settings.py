"""Settings: the environment's words, checked, and one place where the catalog lies."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from pydantic import SecretStr, ValidationError

from services.cli.environment import is_secret, read_settings
from shared.config import settings as settings_module
from shared.config.settings import SECRET_SETTINGS, Settings, usable_processors
from shared.errors import Conflict, Misconfigured
from shared.storage.s3 import Bucket


def test_env_file_is_read_and_the_environment_goes_before_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    env_file = tmp_path / "some.env"
    env_file.write_text("PORT=1234\nHOST=0.0.0.0\nSOMETHING_ELSE=1\n")
    monkeypatch.setitem(Settings.model_config, "env_file", str(env_file))
    monkeypatch.setenv("HOST", "::1")
    settings = Settings()
    assert (settings.port, settings.host) == (1234, "::1")


@pytest.mark.parametrize(
    ("device", "processors", "batch", "decoders"),
    [("cpu", 1, 16, 2), ("cpu", 16, 16, 4), ("cuda", 1, 64, 2), ("cuda", 16, 64, 14)],
)
def test_batches_and_decoders_follow_from_the_device_unless_they_are_set(
    monkeypatch: pytest.MonkeyPatch, device: str, processors: int, batch: int, decoders: int
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(processors)))
    chosen = Settings().for_device(device)
    assert (chosen.batch_photos, chosen.decode_processes) == (batch, decoders)
    monkeypatch.setenv("BATCH_PHOTOS", "7")
    monkeypatch.setenv("DECODE_PROCESSES", "3")
    kept = Settings().for_device(device)
    assert (kept.batch_photos, kept.decode_processes) == (7, 3)


def test_processors_are_those_of_the_container_and_counted_on_every_system(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    limit = tmp_path / "cpu.max"
    monkeypatch.setattr(settings_module, "CGROUP_CPU_LIMIT_FILE", limit)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(6)))
    assert usable_processors() == 6
    for written, expected in (("max 100000\n", 6), ("250000 100000\n", 2), ("5000 100000\n", 1)):
        limit.write_text(written)
        assert usable_processors() == expected
    limit.unlink()
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    monkeypatch.delattr(os, "sched_getaffinity")  # as on macOS
    assert usable_processors() == 8


def test_home_is_absolute_wherever_the_process_goes(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PLACEWISE_HOME", "somewhere/below")
    assert Settings().placewise_home == tmp_path / "somewhere" / "below"
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("PLACEWISE_HOME", "~/photos")
    assert Settings().placewise_home == tmp_path / "photos"


@pytest.mark.parametrize("scheme", ["postgres", "postgresql", "postgresql+psycopg"])
def test_catalog_is_sqlite_below_the_home_unless_a_database_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, scheme: str
) -> None:
    assert Settings().catalog_url() == f"sqlite:///{tmp_path / 'home' / 'catalog.sqlite'}"
    monkeypatch.setenv("DATABASE_URL", f"{scheme}://me:secret@db/places")
    assert Settings().catalog_url() == "postgresql+psycopg://me:secret@db/places"


def test_password_of_the_database_is_not_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DATABASE_URL", "postgresql+psycopg://me:hunter2@db/places")
    settings = Settings()
    assert "hunter2" not in repr(settings)
    assert "hunter2" not in settings.model_dump_json()


@pytest.mark.parametrize(
    ("written", "size_bytes"),
    [("10MB", 10_000_000), ("2 GiB", 2 * 2**30), ("1.5kB", 1500), (" 123 ", 123)],
)
def test_sizes_may_have_a_unit(
    monkeypatch: pytest.MonkeyPatch, written: str, size_bytes: int
) -> None:
    monkeypatch.setenv("MAX_FILE_SIZE", written)
    assert Settings().max_file_size == size_bytes


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("PORT", "abc", "PORT=abc: expected a whole number (listening port; 0 picks a free port)"),
        ("PORT", "70000", "PORT=70000: expected a value less than or equal to 65535"),
        ("MAX_FILE_SIZE", "big", "MAX_FILE_SIZE=big: expected a size such as 100MB"),
        ("DEBUG", "perhaps", "DEBUG=perhaps: expected true or false"),
        ("LEASE_SECONDS", "soon", "LEASE_SECONDS=soon: expected a number"),
        ("LEASE_SECONDS", "-1", "LEASE_SECONDS=-1: expected a value greater than 0"),
        ("MIN_FREE_BYTES", "-1", "MIN_FREE_BYTES=-1: expected a value greater than or equal to 0"),
        ("DEVICE", "tpu", "DEVICE=tpu: expected 'auto'"),
        ("DATABASE_URL", "mysql://me:s3cret@db/x", "DATABASE_URL: the scheme 'mysql' is not known"),
        ("DATABASE_URL", "s3cret", "DATABASE_URL: it has no scheme; expected postgresql://"),
        ("ADMIN_KEY", "s3cret", "ADMIN_KEY: a key has at least 16 printable"),
    ],
)
def test_a_bad_setting_is_named_with_its_value_and_what_is_expected(
    monkeypatch: pytest.MonkeyPatch, name: str, value: str, message: str
) -> None:
    detail = refusal(monkeypatch, **{name: value})
    assert detail.startswith(message)
    assert "s3cret" not in detail


S3 = {"S3_ENDPOINT": "s3:8333", "S3_ACCESS_KEY": "placewise", "S3_SECRET_KEY": "a secret"}


def test_s3_uses_https_with_a_bucket_of_its_own_by_default(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert Settings().s3_endpoint is None
    for name, value in S3.items():
        monkeypatch.setenv(name, value)
    settings = Settings()
    assert (settings.s3_endpoint, settings.s3_bucket) == ("s3:8333", "placewise")
    assert settings.s3_secure is True
    assert "a secret" not in repr(settings) + settings.model_dump_json()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"S3_SECRET_KEY": ""}, "S3_ENDPOINT needs S3_ACCESS_KEY and S3_SECRET_KEY"),
        ({"S3_ENDPOINT": "http://s3:8333"}, "S3_SECURE selects HTTPS"),
        ({"S3_ENDPOINT": "s3:8333/placewise"}, "without a scheme"),
        ({"S3_BUCKET": "Photos"}, "lower-case letters"),
        ({"UPLOAD_DIR": "./uploads"}, "Unset one of the two"),
    ],
)
def test_settings_of_s3_that_can_not_work_are_refused(
    monkeypatch: pytest.MonkeyPatch, changed: dict[str, str], message: str
) -> None:
    assert message in refusal(monkeypatch, **{**S3, **changed})


@pytest.mark.parametrize("endpoint", ["s3.example.com", "10.0.0.5:8333", "[::1]:9000"])
def test_endpoints_are_hosts_with_or_without_a_port(
    monkeypatch: pytest.MonkeyPatch, endpoint: str
) -> None:
    for name, value in {**S3, "S3_ENDPOINT": endpoint}.items():
        monkeypatch.setenv(name, value)
    assert Bucket.from_settings(Settings()).endpoint == endpoint


def test_an_empty_variable_is_an_unset_one(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DINO_WEIGHTS", "DINO_MODEL", "DESC_LAYER", "DATABASE_URL", "PORT"):
        monkeypatch.setenv(name, "")
    settings = Settings()
    assert settings.dino_weights is None
    assert settings.new_map_extractor == "test-tiny-avg"
    assert (settings.database_url, settings.port) == (None, 8000)


def test_path_of_the_weights_is_absolute_and_a_link_keeps_its_name(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "model.safetensors").symlink_to(tmp_path / "3fa9c2")
    monkeypatch.setenv("DINO_WEIGHTS", "model.safetensors")
    assert Settings().dino_weights == tmp_path / "model.safetensors"
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("DINO_WEIGHTS", "~/vitg.pth")
    assert Settings().dino_weights == tmp_path / "vitg.pth"


# --- the extractor of new maps ---------------------------------------------------------------


@pytest.fixture
def production(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither EXTRACTOR nor the extractors for tests."""
    monkeypatch.delenv("EXTRACTOR")
    monkeypatch.delenv("ALLOW_TEST_EXTRACTORS")


def refusal(monkeypatch: pytest.MonkeyPatch, **variables: str) -> str:
    """What a person reads when these settings are refused."""
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(Misconfigured) as caught:
        read_settings()
    assert caught.value.code == "bad_setting"
    return caught.value.detail


PREDECESSORS = {
    "DINO_MODEL": "dinov2_vitg14",
    "DESC_LAYER": "31",
    "DESC_FACET": "value",
    "VLAD_CLUSTERS": "64",
    "VLAD_DESC_DIM": "1536",
}


@pytest.mark.usefixtures("production")
@pytest.mark.parametrize(
    ("variables", "extractor"),
    [
        ({}, "efficientnet-lite0-vlad128"),
        (PREDECESSORS, "anyloc-vitg14"),
        ({**PREDECESSORS, "VLAD_CLUSTERS": "32"}, "anyloc-vitg14:clusters=32"),
        ({"DINO_MODEL": "dinov2_vitl14", "DESC_LAYER": "20"}, "anyloc-vitl14"),
        (
            {"DINO_MODEL": "dinov2_vits14", "DESC_LAYER": "9", "DESC_FACET": "key"},
            "anyloc-vits14:facet=key,layer=9",
        ),
        ({"DINO_MODEL": "dinov2_vitb14", "EXTRACTOR": "anyloc-vitb14"}, "anyloc-vitb14"),
        ({"EXTRACTOR": "anyloc-vitb14:layer=9,clusters=8"}, "anyloc-vitb14:clusters=8,layer=9"),
    ],
)
def test_extractor_of_new_maps_has_its_canonical_name(
    monkeypatch: pytest.MonkeyPatch, variables: dict[str, str], extractor: str
) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert Settings().new_map_extractor == extractor


@pytest.mark.usefixtures("production")
@pytest.mark.parametrize("model", ["vitg14", "dinov2_vitg14_reg"])
def test_an_unknown_dino_model_is_refused_with_the_known_ones(
    monkeypatch: pytest.MonkeyPatch, model: str
) -> None:
    message = refusal(monkeypatch, DINO_MODEL=model)
    assert message.startswith(f"DINO_MODEL={model} is unknown")
    assert "dinov2_vits14, dinov2_vitb14, dinov2_vitl14, dinov2_vitg14" in message


@pytest.mark.usefixtures("production")
@pytest.mark.parametrize("name", [name for name in PREDECESSORS if name != "DINO_MODEL"])
def test_options_of_dino_are_refused_without_it(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    message = refusal(monkeypatch, **{name: PREDECESSORS[name]})
    assert message.startswith(f"{name}={PREDECESSORS[name]} configures DINO_MODEL")


@pytest.mark.usefixtures("production")
@pytest.mark.parametrize(
    ("variables", "message"),
    [
        (
            {"EXTRACTOR": "anyloc-vitb14", "DINO_MODEL": "dinov2_vitb14", "VLAD_CLUSTERS": "32"},
            (
                "EXTRACTOR=anyloc-vitb14 contradicts DINO_MODEL=dinov2_vitb14, which means "
                "anyloc-vitb14:clusters=32"
            ),
        ),
        (
            {**PREDECESSORS, "VLAD_DESC_DIM": "768"},
            "VLAD_DESC_DIM=768 contradicts DINO_MODEL=dinov2_vitg14, whose features have 1536",
        ),
        (
            {"DINO_MODEL": "dinov2_vitb14", "DESC_LAYER": "31"},
            (
                "DESC_LAYER=31 with DINO_MODEL=dinov2_vitb14: The option layer=31 of anyloc-vitb14 "
                "can't be used: layer is a whole number from 0 to 11"
            ),
        ),
        ({**PREDECESSORS, "DESC_LAYER": "last"}, "DESC_LAYER=last: expected a whole number"),
        ({**PREDECESSORS, "DESC_FACET": "values"}, "query, key, value, token"),
        ({**PREDECESSORS, "VLAD_CLUSTERS": "0"}, "VLAD_CLUSTERS=0 with DINO_MODEL=dinov2_vitg14"),
    ],
)
def test_contradictions_are_refused_with_both_values(
    monkeypatch: pytest.MonkeyPatch, variables: dict[str, str], message: str
) -> None:
    assert message in refusal(monkeypatch, **variables)


# --- code of others --------------------------------------------------------------------------

HUB = "torchhub:/models/mine:entry"
UNPINNED = "torchhub:gmberton/MegaLoc:get_trained_model"


def test_only_listed_torch_hub_entries_are_allowed_by_their_canonical_names(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert Settings().allowed_hub_extractors == ()
    monkeypatch.setenv("CODE_ALLOWED", f" {HUB}:b=2,a=01\n{HUB} ")
    settings = Settings()
    assert settings.allowed_hub_extractors == (f"{HUB}:a=1,b=2", HUB)
    assert settings.extractor_config(f"{HUB}:b=02,a=1").name == f"{HUB}:a=1,b=2"
    with pytest.raises(Misconfigured, match="CODE_ALLOWED") as caught:
        settings.extractor_config(f"{HUB}:a=1")
    assert caught.value.code == "code_not_allowed"


def test_the_extractor_of_new_maps_is_allowed_by_being_chosen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("EXTRACTOR", f"{HUB}:a=01")
    assert Settings().allowed_hub_extractors == (f"{HUB}:a=1",)
    assert Settings().extractor_config(f"{HUB}:a=1").hub is not None


@pytest.mark.parametrize(
    ("variable", "value", "message"),
    [
        ("CODE_ALLOWED", UNPINNED, "git ls-remote"),
        (
            "CODE_ALLOWED",
            f"{HUB} anyloc-vitb14",
            "'anyloc-vitb14' is neither a torch.hub extractor",
        ),
        ("EXTRACTOR", UNPINNED, "git ls-remote"),
    ],
)
def test_code_that_is_not_pinned_is_refused_at_the_start(
    monkeypatch: pytest.MonkeyPatch, variable: str, value: str, message: str
) -> None:
    assert message in refusal(monkeypatch, **{variable: value})


def test_every_secret_may_be_in_a_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    secrets = {
        "ADMIN_KEY": "0123456789abcdef",
        "DATABASE_URL": "postgresql+psycopg://placewise:secret@db/placewise",
        "MILVUS_URI": "http://user:secret@milvus:19530",
        "REDIS_URL": "redis://:secret@redis:6379/0",
        "S3_ACCESS_KEY": "placewise",
        "S3_SECRET_KEY": "secret",
    }
    assert set(secrets) == set(SECRET_SETTINGS)
    hidden = {name for name, field in Settings.model_fields.items() if is_secret(field)}
    assert hidden <= {name.lower() for name in SECRET_SETTINGS}
    for name, value in secrets.items():
        (tmp_path / name).write_text(f"{value}\n")
        monkeypatch.setenv(f"{name}_FILE", str(tmp_path / name))
    read = Settings().model_dump()
    for name, value in secrets.items():
        found = read[name.lower()]
        assert (found.get_secret_value() if isinstance(found, SecretStr) else found) == value


def test_a_secret_file_may_be_named_in_the_env_file(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "key").write_text("0123456789abcdef")
    env_file = tmp_path / "some.env"
    env_file.write_text(f"ADMIN_KEY_FILE={tmp_path / 'key'}\n")
    monkeypatch.setitem(Settings.model_config, "env_file", str(env_file))
    key = Settings().admin_key
    assert key is not None
    assert key.get_secret_value() == "0123456789abcdef"


def test_a_secret_file_that_cannot_be_read_or_is_ambiguous_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("ADMIN_KEY_FILE", str(tmp_path / "missing"))
    with pytest.raises(Misconfigured, match=r"ADMIN_KEY_FILE=.*missing: No such file") as error:
        read_settings()
    assert error.value.code == "bad_setting"
    (tmp_path / "missing").write_text("\n")
    with pytest.raises(Misconfigured, match="the file is empty"):
        read_settings()
    (tmp_path / "missing").write_text("0123456789abcdef")
    monkeypatch.setenv("ADMIN_KEY", "another-key-of-an-operator")
    with pytest.raises(Misconfigured, match="both set") as error:
        read_settings()
    assert "another-key" not in error.value.detail


def test_rows_that_milvus_can_not_hold_are_refused_with_what_helps() -> None:
    on_milvus = Settings(search_engine="milvus", milvus_uri=SecretStr("http://milvus:19530"))
    for allowed in (None, 8192, 32_768):
        on_milvus.check_row_length(allowed)
    Settings().check_row_length(98_304)
    with pytest.raises(Conflict, match="placewise maps switch NAME --pca 8192") as refused:
        on_milvus.check_row_length(98_304)
    assert (refused.value.code, refused.value.extra) == ("rows_too_long", {"dimension": 98_304})


def test_a_milvus_uri_that_is_none_is_refused_without_repeating_its_secret() -> None:
    with pytest.raises(ValidationError) as refused:
        Settings(milvus_uri=SecretStr("milvus:secret@19530"))
    assert "secret" not in str(refused.value)
