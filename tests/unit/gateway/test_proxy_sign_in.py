"""Users whom a trusted proxy has signed in, and everybody else who says so."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from starlette.datastructures import Headers
from starlette.testclient import TestClient

from services.gateway.authentication import (
    ADMIN,
    ApiKeyAuthenticator,
    AuthenticationMiddleware,
    Authenticator,
    Caller,
)
from services.gateway.proxy_sign_in import with_proxy_sign_in
from services.http_server import PEER_ADDRESS
from shared.catalog.database.session import Catalog
from shared.config.settings import Settings
from shared.errors import Forbidden, Unauthorized
from shared.http.problem_details import install_exception_handlers
from shared.security.api_keys import ALL_SCOPES, Scope, hash_api_key

KEY = "pw_0123456789abcdef"
PROXY = "10.0.0.5"


@pytest.fixture
def keys(migrated_sqlite: Path) -> Iterator[Authenticator]:
    catalog = Catalog(f"sqlite:///{migrated_sqlite}")
    yield ApiKeyAuthenticator(catalog, hash_api_key(KEY))
    catalog.close()


@pytest.fixture
def sign_in(keys: Authenticator, monkeypatch: pytest.MonkeyPatch) -> Authenticator:
    monkeypatch.setenv("SIGN_IN_PROXIES", f"{PROXY}, fd00::/8")
    monkeypatch.setenv("SIGN_IN_SCOPES", "*:read, editors:write, chiefs:admin")
    return with_proxy_sign_in(keys, Settings())


def call(authenticator: Authenticator, peer: str | None, *pairs: tuple[str, str]) -> Caller:
    raw = [(b"host", b"places.example"), *((n.lower().encode(), v.encode()) for n, v in pairs)]
    return asyncio.run(authenticator.authenticate(Headers(raw=raw), peer))


def code(authenticator: Authenticator, peer: str | None, *pairs: tuple[str, str]) -> str:
    with pytest.raises((Unauthorized, Forbidden)) as caught:
        call(authenticator, peer, *pairs)
    return caught.value.code


USER = ("X-Forwarded-User", "ada")


@pytest.mark.parametrize("peer", [PROXY, f"::ffff:{PROXY}", "fd12::1"])
def test_a_user_of_the_proxy_has_the_scopes_of_the_groups(
    sign_in: Authenticator, peer: str
) -> None:
    assert call(sign_in, peer, USER) == Caller("user ada", frozenset({Scope.READ}))
    editor = call(sign_in, peer, USER, ("X-Forwarded-Groups", "others, editors"))
    assert editor.scopes == {Scope.READ, Scope.WRITE}
    assert call(sign_in, peer, USER, ("X-Forwarded-Groups", "chiefs")).scopes == ALL_SCOPES


def test_a_user_without_the_scope_gets_the_setting_that_grants_it(sign_in: Authenticator) -> None:
    app = FastAPI()
    install_exception_handlers(app)
    app.add_middleware(AuthenticationMiddleware, authenticator=sign_in)

    @app.get("/api/v1/keys", dependencies=[ADMIN])
    def read_keys() -> None:
        pass

    async def through_proxy(scope: Any, receive: Any, send: Any) -> None:
        await app({**scope, PEER_ADDRESS: PROXY}, receive, send)

    client = TestClient(through_proxy, base_url="http://places.example")
    detail = client.get("/api/v1/keys", headers=[USER]).json()["detail"]
    assert detail.startswith("This request needs the scope admin; the caller has read.")
    assert "SIGN_IN_SCOPES" in detail


@pytest.mark.parametrize("peer", ["10.0.0.6", "::ffff:10.0.0.6", "127.0.0.1", "", None])
def test_user_headers_of_untrusted_peers_are_ignored(
    sign_in: Authenticator, peer: str | None
) -> None:
    chief = (USER, ("X-Forwarded-Groups", "chiefs"), ("X-Forwarded-For", PROXY))
    assert code(sign_in, peer, *chief) == "key_missing"


def test_an_api_key_takes_precedence_over_the_user(sign_in: Authenticator) -> None:
    assert call(sign_in, PROXY, USER, ("Authorization", f"Bearer {KEY}")).identity == "admin"
    assert code(sign_in, PROXY, USER, ("Authorization", "Bearer wrong")) == "key_unknown"
    assert code(sign_in, PROXY) == "key_missing"


@pytest.mark.parametrize("names", [("ada", "eve"), ("",), ("  ",), ("x" * 201,)])
def test_a_repeated_empty_or_long_user_header_is_refused(
    sign_in: Authenticator, names: tuple[str, ...]
) -> None:
    headers = [("X-Forwarded-User", name) for name in names]
    assert code(sign_in, PROXY, *headers) == "proxy_user_invalid"


def test_pages_of_other_origins_can_not_use_the_cookie_of_the_proxy(sign_in: Authenticator) -> None:
    assert code(sign_in, PROXY, USER, ("Origin", "https://evil.example")) == "foreign_page"
    assert call(sign_in, PROXY, USER, ("Origin", "https://places.example")).identity == "user ada"


def test_without_the_setting_no_user_is_signed_in(keys: Authenticator) -> None:
    assert with_proxy_sign_in(keys, Settings()) is keys
    assert code(keys, PROXY, USER) == "key_missing"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("SIGN_IN_PROXIES", "proxy.example"),
        ("SIGN_IN_SCOPES", "editors"),
        ("SIGN_IN_SCOPES", "editors:everything"),
    ],
)
def test_settings_that_can_not_work_are_refused(
    monkeypatch: pytest.MonkeyPatch, name: str, value: str
) -> None:
    monkeypatch.setenv(name, value)
    with pytest.raises(ValueError, match=name.lower()):
        Settings()
