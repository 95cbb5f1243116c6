"""Keys: what a header has to look like, which key is in force, and what is left on the disk."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest
from pydantic import SecretStr, ValidationError
from starlette.datastructures import Headers

from services.gateway.keys import KnownKeys, NoKeys, read_bearer
from shared.admin_key import admin_key, admin_key_file, hash_key, is_loopback
from shared.errors import Forbidden, Misconfigured, Unauthorized
from shared.home import announced, running_server, write_private
from shared.settings import Settings

KEY = "pw_0123456789abcdef"


# --- the header ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "header", ["Bearer abc", "bearer abc", "BEARER abc", "Bearer   abc", "Bearer abc "]
)
def test_the_key_is_read_whatever_the_schemes_case(header: str) -> None:
    assert read_bearer(header) == "abc"


@pytest.mark.parametrize(
    "header",
    [
        None,
        "",
        "Bearer",
        "Bearer ",
        "abc",
        "Basic dXNlcjpwYXNz",
        "Bearerabc",
        "Bearer a b",
        "Bearer a\tb",
        "Bearer schlüssel",
        "Token Bearer abc",
        "Bearer abc\n",
    ],
)
def test_a_header_without_a_bearer_key_holds_none(header: str | None) -> None:
    with pytest.raises(Unauthorized) as caught:
        read_bearer(header)
    assert caught.value.code == "key_missing"
    assert "Authorization: Bearer KEY" in caught.value.detail


def test_any_of_the_known_keys_opens_and_no_other() -> None:
    keys = KnownKeys(hash_key(KEY), hash_key("another"))
    keys.check(Headers({"authorization": f"Bearer {KEY}"}))
    keys.check(Headers({"authorization": "Bearer another", "origin": "https://elsewhere.example"}))
    for wrong in (KEY[:-1], KEY + "x", KEY.upper(), hash_key(KEY)):
        with pytest.raises(Unauthorized) as caught:
            keys.check(Headers({"authorization": f"Bearer {wrong}"}))
        assert caught.value.code == "key_unknown"
        assert wrong not in caught.value.detail
    with pytest.raises(Unauthorized):
        KnownKeys().check(Headers({"authorization": f"Bearer {KEY}"}))


LOCAL = [
    "localhost",
    "localhost:8000",
    "LOCALHOST:80",
    "localhost.",
    "127.0.0.1:8000",
    "[::1]:8000",
]


@pytest.mark.parametrize("host", LOCAL)
def test_without_keys_whoever_calls_this_machine_may(host: str) -> None:
    NoKeys().check(Headers({"host": host}))
    NoKeys().check(Headers({"host": host, "authorization": "Bearer whatever"}))
    NoKeys().check(Headers({"host": host, "origin": f"http://{host}"}))


@pytest.mark.parametrize(
    "said",
    [
        {},
        {"host": ""},
        {"host": "["},
        {"host": "evil.example"},  # a name of theirs that leads to this machine
        {"host": "evil.example:8000", "origin": "http://evil.example:8000"},
        {"host": "localhost.evil.example"},
        {"host": "192.168.0.7:8000"},
        {"host": "localhost:8000", "origin": "https://evil.example"},
        {"host": "localhost:8000", "origin": "http://localhost:9000"},
        {"host": "localhost:8000", "origin": "null"},
        {"host": "localhost:8000", "origin": ""},
    ],
)
def test_without_keys_no_page_of_elsewhere_may_call(said: dict[str, str]) -> None:
    with pytest.raises(Forbidden) as caught:
        NoKeys().check(Headers(said))
    assert caught.value.code == "foreign_page"


# --- the key in force ------------------------------------------------------------------------


def test_a_made_key_is_shown_once_and_kept_as_a_hash(tmp_path: Path) -> None:
    first = admin_key(tmp_path, None, new=False)
    assert first.made is not None
    assert first.made.startswith("pw_")
    assert len(first.made) > 40
    assert first.made not in repr(first)
    assert admin_key_file(tmp_path).read_text() == f"{hash_key(first.made)}\n"
    assert stat.S_IMODE(admin_key_file(tmp_path).stat().st_mode) == 0o600
    again = admin_key(tmp_path, None, new=False)
    assert (again.sha256, again.made) == (first.sha256, None)


def test_a_new_key_takes_the_place_of_the_old_one(tmp_path: Path) -> None:
    first = admin_key(tmp_path, None, new=False)
    second = admin_key(tmp_path, None, new=True)
    assert second.made
    assert second.sha256 != first.sha256
    assert admin_key(tmp_path, None, new=False).sha256 == second.sha256


def test_a_chosen_key_is_used_and_not_stored(tmp_path: Path) -> None:
    made = admin_key(tmp_path, None, new=False)
    chosen = admin_key(tmp_path, SecretStr(KEY), new=False)
    assert (chosen.sha256, chosen.made) == (hash_key(KEY), None)
    assert admin_key_file(tmp_path).read_text() == f"{made.sha256}\n"
    with pytest.raises(Misconfigured) as caught:
        admin_key(tmp_path, SecretStr(KEY), new=True)
    assert caught.value.code == "admin_key_chosen"


@pytest.mark.parametrize("text", ["", "not a hash", "ab" * 31, "G" * 64, "ab" * 33])
def test_a_broken_hash_file_is_named_and_never_opens(tmp_path: Path, text: str) -> None:
    admin_key_file(tmp_path).write_text(text)
    with pytest.raises(Misconfigured) as caught:
        admin_key(tmp_path, None, new=False)
    assert caught.value.code == "admin_key_unreadable"
    assert str(admin_key_file(tmp_path)) in caught.value.detail


@pytest.mark.parametrize("value", ["short", "x" * 15, "with a blank in it all", "schlüssel" * 4])
def test_a_chosen_key_that_can_be_guessed_or_not_be_sent_is_refused(
    monkeypatch: pytest.MonkeyPatch, value: str
) -> None:
    monkeypatch.setenv("ADMIN_KEY", value)
    with pytest.raises(ValidationError, match="admin_key") as caught:
        Settings()
    assert value not in str(caught.value.errors(include_input=False))


def test_a_chosen_key_is_masked_and_an_empty_one_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ADMIN_KEY", KEY)
    settings = Settings()
    assert settings.admin_key == SecretStr(KEY)
    assert KEY not in repr(settings) + settings.model_dump_json()
    monkeypatch.setenv("ADMIN_KEY", "")
    assert Settings().admin_key is None


# --- where it is needed ----------------------------------------------------------------------


@pytest.mark.parametrize("host", ["127.0.0.1", "127.8.9.10", "::1", "localhost", "LocalHost"])
def test_loopback_is_reached_by_this_machine_alone(host: str) -> None:
    assert is_loopback(host)


@pytest.mark.parametrize(
    "host", ["0.0.0.0", "::", "192.168.1.5", "fe80::1", "places.example", "", "localhost.example"]
)
def test_every_other_address_is_beyond_loopback(host: str) -> None:
    assert not is_loopback(host)


# --- the folder ------------------------------------------------------------------------------


def test_what_is_written_privately_is_readable_by_its_user_alone(tmp_path: Path) -> None:
    file = tmp_path / "secret"
    file.write_text("an old one that everyone could read")
    file.chmod(0o644)
    left_over = tmp_path / ".secret.partial"
    left_over.write_text("of a killed process")
    left_over.chmod(0o644)
    write_private(file, "new")
    assert file.read_text() == "new"
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert list(tmp_path.iterdir()) == [file]


def test_a_folder_without_a_server_gives_no_key_away(tmp_path: Path) -> None:
    with announced(tmp_path, "http://127.0.0.1:1", KEY):
        assert running_server(tmp_path) is None, "nobody holds the folder's lock"
