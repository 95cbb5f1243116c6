"""Keys: what a header has to look like, what a key may do, and when none is needed."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import SecretStr, ValidationError
from starlette.datastructures import Headers

from services.gateway.authentication import (
    ApiKeyAuthenticator,
    Authenticator,
    Caller,
    LocalhostAuthenticator,
    parse_bearer,
)
from shared.catalog.database.session import Catalog
from shared.config.settings import Settings
from shared.errors import Forbidden, Unauthorized, Unavailable
from shared.security.api_keys import (
    Scope,
    api_key_prefix,
    expand_scopes,
    generate_api_key,
    hash_api_key,
    is_loopback,
)

KEY = "pw_0123456789abcdef"


# --- the header ------------------------------------------------------------------------------


@pytest.mark.parametrize("header", ["Bearer abc", "bEARER abc", "Bearer   abc "])
def test_the_bearer_scheme_is_case_insensitive(header: str) -> None:
    assert parse_bearer(header) == "abc"


@pytest.mark.parametrize(
    "header",
    [
        None,
        "Bearer ",
        "abc",
        "Basic dXNlcjpwYXNz",
        "Bearerabc",
        "Bearer a b",
        "Bearer schlüssel",
        "Bearer abc\n",
    ],
)
def test_a_header_without_a_bearer_key_holds_none(header: str | None) -> None:
    with pytest.raises(Unauthorized) as caught:
        parse_bearer(header)
    assert caught.value.code == "key_missing"
    assert "Authorization: Bearer KEY" in caught.value.detail


@pytest.fixture
def none_stored(migrated_sqlite: Path) -> Iterator[Catalog]:
    """A catalog without keys."""
    opened = Catalog(f"sqlite:///{migrated_sqlite}")
    yield opened
    opened.close()


def check(keys: Authenticator, **headers: str) -> Caller:
    return asyncio.run(keys.authenticate(Headers(headers)))


def test_configured_keys_have_every_scope(none_stored: Catalog) -> None:
    keys = ApiKeyAuthenticator(none_stored, hash_api_key(KEY), hash_api_key("another"))
    assert check(keys, authorization=f"Bearer {KEY}").scopes == set(Scope)
    check(keys, authorization="Bearer another", origin="https://elsewhere.example")
    for wrong in (KEY[:-1], KEY + "x", KEY.upper(), hash_api_key(KEY)):
        with pytest.raises(Unauthorized) as caught:
            check(keys, authorization=f"Bearer {wrong}")
        assert caught.value.code == "key_unknown"
        assert wrong not in caught.value.detail
    with pytest.raises(Unauthorized):
        check(ApiKeyAuthenticator(none_stored), authorization=f"Bearer {KEY}")


def test_while_the_catalog_is_unreachable_only_the_configured_keys_are_accepted() -> None:
    away = Catalog("postgresql+psycopg://nobody@127.0.0.1:9/none")
    keys = ApiKeyAuthenticator(away, hash_api_key(KEY))
    check(keys, authorization=f"Bearer {KEY}")
    with pytest.raises(Unavailable) as caught:
        check(keys, authorization="Bearer pw_of_the_catalog")
    assert caught.value.code == "catalog_unavailable"
    away.close()


def test_a_key_is_long_and_random_and_its_prefix_is_short() -> None:
    made = {generate_api_key() for _ in range(100)}
    assert len({api_key_prefix(key) for key in made}) == 100
    for key in made:
        assert re.fullmatch(r"pw_[\w-]{43}", key)
        assert len(key) - len(api_key_prefix(key)) > 32


@pytest.mark.parametrize(
    ("host", "expected"),
    [
        *((host, True) for host in ("127.8.9.10", "::1", "LocalHost")),
        *((host, False) for host in ("0.0.0.0", "::", "fe80::1", "", "localhost.example")),
    ],
)
def test_loopback_addresses_are_those_that_only_this_machine_reaches(
    host: str, expected: bool
) -> None:
    assert is_loopback(host) is expected


def test_the_admin_scope_implies_all_and_no_other_implies_one() -> None:
    assert expand_scopes([Scope.ADMIN]) == set(Scope)
    assert expand_scopes([Scope.WRITE]) == {Scope.WRITE}
    assert expand_scopes([Scope.READ, Scope.WRITE]) == {Scope.READ, Scope.WRITE}


@pytest.mark.parametrize("host", ["LOCALHOST:80", "localhost.", "127.0.0.1:8000", "[::1]:8000"])
def test_without_keys_calls_on_loopback_are_allowed(host: str) -> None:
    check(LocalhostAuthenticator(), host=host)
    check(LocalhostAuthenticator(), host=host, authorization="Bearer whatever")
    check(LocalhostAuthenticator(), host=host, origin=f"http://{host}")


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"host": ""},
        {"host": "["},
        {"host": "evil.example"},  # a name of theirs that leads to this machine
        {"host": "evil.example:8000", "origin": "http://evil.example:8000"},
        {"host": "localhost.evil.example"},
        {"host": "localhost:8000", "origin": "https://evil.example"},
        {"host": "localhost:8000", "origin": "http://localhost:9000"},
        {"host": "localhost:8000", "origin": "null"},
        {"host": "localhost:8000", "origin": ""},
    ],
)
def test_without_keys_cross_origin_calls_are_refused(fields: dict[str, str]) -> None:
    with pytest.raises(Forbidden) as caught:
        check(LocalhostAuthenticator(), **fields)
    assert caught.value.code == "foreign_page"
    host = fields.get("host", "")
    refused = fields.get("origin") if host.startswith("localhost:") else host
    assert repr(refused) in caught.value.detail


@pytest.mark.parametrize(
    "header", ["Forwarded", "Via", "X-Forwarded-For", "x-forwarded-host", "X-Real-Ip"]
)
def test_without_keys_what_a_proxy_forwards_is_refused(header: str) -> None:
    with pytest.raises(Forbidden, match="ADMIN_KEY") as caught:
        check(LocalhostAuthenticator(), **{"host": "localhost:8000", header: "127.0.0.1"})
    assert caught.value.code == "forwarded_request"
    assert header.lower() in caught.value.detail.lower()


def test_without_keys_a_trusted_origin_may_call_loopback() -> None:
    keys = LocalhostAuthenticator(["https://maps.example"])
    check(keys, host="localhost:8000", origin="https://maps.example")
    for reported in ({"origin": "https://maps.example.evil"}, {"host": "maps.example"}):
        with pytest.raises(Forbidden):
            check(keys, **{"host": "localhost", "origin": "https://maps.example", **reported})


# --- ADMIN_KEY ----------------------------------------------------------------------------------


@pytest.mark.parametrize("value", ["short", "x" * 15, "with a blank in it all", "schlüssel" * 4])
def test_a_weak_or_unsendable_admin_key_is_refused(
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
