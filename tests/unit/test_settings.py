"""Settings: the environment's words, checked, and one place where the catalog lies."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from shared.settings import Settings


def test_environment_decides_and_the_rest_has_defaults(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("MAX_FILE_SIZE", "123")
    monkeypatch.setenv("LEASE_SECONDS", "0.5")
    settings = Settings()
    assert settings.max_file_size == 123
    assert settings.lease_seconds == 0.5
    assert settings.placewise_home == tmp_path / "home"
    assert settings.max_attempts == 3


def test_outside_of_tests_the_real_extractor_is_the_default(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("EXTRACTOR")
    monkeypatch.delenv("ALLOW_TEST_EXTRACTORS")
    assert Settings().extractor == "efficientnet-lite0-vlad"
    assert Settings().allow_test_extractors is False


def test_env_file_is_read_and_the_environment_goes_before_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    env_file = tmp_path / "some.env"
    env_file.write_text("PORT=1234\nHOST=0.0.0.0\nSOMETHING_ELSE=1\n")
    monkeypatch.setitem(Settings.model_config, "env_file", str(env_file))
    monkeypatch.setenv("HOST", "::1")
    settings = Settings()
    assert (settings.port, settings.host) == (1234, "::1")


def test_home_is_absolute_wherever_the_process_goes(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PLACEWISE_HOME", "somewhere/below")
    assert Settings().placewise_home == tmp_path / "somewhere" / "below"
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("PLACEWISE_HOME", "~/photos")
    assert Settings().placewise_home == tmp_path / "photos"


def test_catalog_is_sqlite_below_the_home_unless_a_database_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert Settings().catalog_url() == f"sqlite:///{tmp_path / 'home' / 'catalog.sqlite'}"
    monkeypatch.setenv("DATABASE_URL", "postgresql+psycopg://me:secret@db/places")
    assert Settings().catalog_url() == "postgresql+psycopg://me:secret@db/places"


def test_password_of_the_database_is_not_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DATABASE_URL", "postgresql+psycopg://me:secret@db/places")
    settings = Settings()
    assert "secret" not in repr(settings)
    assert "secret" not in settings.model_dump_json()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("MAX_FILE_SIZE", "0"),
        ("PORT", "70000"),
        ("DEVICE", "tpu"),
        ("LEASE_SECONDS", "-1"),
        ("BATCH_PHOTOS", "many"),
        ("DECODE_MEMORY_BYTES", "1000"),
        ("MAX_ATTEMPTS", "0"),
    ],
)
def test_values_out_of_range_are_refused_by_name(
    monkeypatch: pytest.MonkeyPatch, name: str, value: str
) -> None:
    monkeypatch.setenv(name, value)
    with pytest.raises(ValidationError, match=name.lower()):
        Settings()


def test_settings_in_force_do_not_change(settings: Settings) -> None:
    with pytest.raises(ValidationError, match="frozen"):
        settings.port = 1  # type: ignore[misc]
