"""Settings of the HTTP API: authentication, connection limits, upload limits, backpressure."""

from __future__ import annotations

import math
import re
from ipaddress import ip_network
from typing import Self

from pydantic import Field, SecretStr, field_validator, model_validator
from pydantic_settings import BaseSettings

from shared.config.values import Size, split_list
from shared.security.api_keys import Scope

MIN_ADMIN_KEY_CHARACTERS = 16
MAX_BATCH_PHOTOS = 1_000_000
OPENSTREETMAP_TILES = "https://tile.openstreetmap.org/{z}/{x}/{y}.png"
OPENSTREETMAP_ATTRIBUTION = "© OpenStreetMap contributors"


class GatewaySettings(BaseSettings):
    """Authentication, rate limits, quotas, request limits and the map of the web page."""

    admin_key: SecretStr | None = Field(
        None,
        description="API key with every permission, in addition to those of `placewise keys`; "
        "unset: the embedded Placewise needs no key on loopback, and creates one at its first "
        "start on any other address",
    )
    cors_origins: str | None = Field(
        None,
        description="origins whose pages may call the API (CORS), separated by commas: "
        "https://maps.example.com; unset: none",
    )

    # Limits against slow and against many clients, for every HTTP server of Placewise.
    max_connections: int = Field(
        2000,
        ge=1,
        description="open connections of one server; fewer where the limit of open files is lower",
    )
    max_connections_per_address: int = Field(
        200,
        ge=0,
        description="open connections from one address (IPv6: from one /64); 0: no limit",
    )
    trusted_proxies: str | None = Field(
        None,
        description="addresses or networks of trusted reverse proxies, separated by commas: "
        "10.0.0.5, 192.168.0.0/16. Their `X-Forwarded-For` is trusted, and their connections are "
        "not limited per address; unset: none",
    )
    sign_in_proxies: str | None = Field(
        None,
        description="addresses or networks of proxies that sign users in, separated by commas. "
        "Their headers `X-Forwarded-User` and `X-Forwarded-Groups` name the user of a request "
        "without a key; unset: none",
    )
    sign_in_scopes: str = Field(
        "",
        description="scopes of the groups of signed-in users, separated by commas; `*` is every "
        "user: *:read, editors:write, vpr-admins:admin",
    )

    # Rate limit and quota of keys that have none of their own. ADMIN_KEY is not limited.
    key_requests_per_minute: int | None = Field(
        None, ge=1, description="rate limit of one key, requests per minute; unset: no limit"
    )
    key_max_photos: int | None = Field(
        None, ge=1, description="photos that one key may store; unset: no limit"
    )

    webhook_private_addresses: bool = Field(
        False,
        description="allow webhooks to private addresses and over plain HTTP: anyone who may "
        "create a webhook can then reach what the steward can reach",
    )

    map_tiles: str | None = Field(
        OPENSTREETMAP_TILES,
        description="URL template of the streets in the web page's maps; if it is set, browsers "
        "load them at once, otherwise when their user has agreed; `off`: a coordinate grid only",
    )
    map_attribution: str | None = Field(
        None,
        description="attribution of MAP_TILES, as their licence requires; unset: that of "
        "OpenStreetMap for its tiles",
    )

    # Upload limits.
    max_file_size: Size = Field(100_000_000, gt=0, description="maximum bytes of one photo")
    max_image_pixels: int = Field(
        200_000_000, gt=0, description="maximum width x height of one photo"
    )

    # Backpressure: requests are rejected before a queue or a disk fills up.
    max_queued_jobs: int = Field(
        200_000,
        ge=1,
        description="queued jobs at which requests that create further jobs are rejected; one map "
        "may have half of them, so that a batch has at most as many photos; in addition, a 200th "
        "as many query photos may wait, but at least 10",
    )
    max_concurrent_uploads: int = Field(
        32,
        ge=1,
        description="files that one gateway receives at the same time, half of them from one key "
        "or address; the same number of query photos is allowed in addition",
    )
    min_free_bytes: Size = Field(
        500_000_000,
        ge=0,
        description="free disk space of PLACEWISE_HOME and UPLOAD_DIR below which uploads and "
        "tracks are rejected and batches wait; query photos are rejected below a tenth of it",
    )

    @field_validator("admin_key")
    @classmethod
    def _check_admin_key(cls, value: SecretStr | None) -> SecretStr | None:
        if value is None:
            return None
        key = value.get_secret_value()
        if len(key) < MIN_ADMIN_KEY_CHARACTERS or not re.fullmatch(r"[!-~]+", key):
            raise ValueError(
                f"a key has at least {MIN_ADMIN_KEY_CHARACTERS} printable ASCII characters and no "
                "blanks; generate one with: openssl rand -hex 24"
            )
        return value

    @field_validator("cors_origins")
    @classmethod
    def _check_origins(cls, value: str | None) -> str | None:
        for origin in split_list(value):
            if not re.fullmatch(r"https?://([a-z0-9.-]+|\[[0-9a-f:]+\])(:\d+)?", origin):
                raise ValueError(
                    f"{origin!r} is not an origin. An origin is a scheme, a host and a port in "
                    "lower case, without a path: https://maps.example.com"
                )
        return value

    @field_validator("trusted_proxies", "sign_in_proxies")
    @classmethod
    def _check_networks(cls, value: str | None) -> str | None:
        for address in split_list(value):
            try:
                ip_network(address)
            except ValueError as error:
                raise ValueError(
                    f"{error}; expected an address or network such as 10.0.0.5 or 10.0.0.0/8"
                ) from None
        return value

    @field_validator("sign_in_scopes")
    @classmethod
    def _check_group_scopes(cls, value: str) -> str:
        for entry in split_list(value):
            group, separator, scope = entry.rpartition(":")
            if not (separator and group and scope in set(Scope)):
                raise ValueError(
                    f"{entry!r} is not GROUP:SCOPE with one of the scopes {', '.join(Scope)}"
                )
        return value

    @field_validator("map_tiles")
    @classmethod
    def _check_tile_url(cls, value: str | None) -> str | None:
        if value == "off":
            return None
        # The host becomes part of the page's Content-Security-Policy: nothing else may follow it.
        if value is not None and not (
            re.fullmatch(r"https?://[A-Za-z0-9.-]+(:\d+)?/[^\s]+", value)
            and all(part in value for part in ("{z}", "{x}", "{y}"))
        ):
            raise ValueError(
                f"{value!r} is not a URL template with {{z}}, {{x}} and {{y}}, such as "
                f"{OPENSTREETMAP_TILES}, or off"
            )
        return value

    @model_validator(mode="after")
    def _check_map_attribution(self) -> Self:
        if self.map_tiles is not None and self.tile_attribution is None:
            raise ValueError(
                "MAP_TILES needs MAP_ATTRIBUTION, which is shown in the corner of the map: "
                f"{OPENSTREETMAP_ATTRIBUTION}"
            )
        return self

    @property
    def max_queued_queries(self) -> int:
        """Queued query photos, without uploads: their callers wait, so fewer than other jobs."""
        return max(10, self.max_queued_jobs // 200)

    @property
    def max_batch_photos(self) -> int:
        """Photos of one batch, which become jobs of one map."""
        return min(MAX_BATCH_PHOTOS, math.ceil(self.max_queued_jobs / 2))

    @property
    def tile_attribution(self) -> str | None:
        """The attribution of MAP_TILES."""
        if self.map_attribution is None and self.map_tiles == OPENSTREETMAP_TILES:
            return OPENSTREETMAP_ATTRIBUTION
        return self.map_attribution

    @property
    def allowed_origins(self) -> tuple[str, ...]:
        """Origins other than the server's own whose pages may call the API."""
        return tuple(dict.fromkeys(split_list(self.cors_origins)))

    @property
    def sign_in_networks(self) -> list[str]:
        """Addresses and networks of the proxies that sign users in."""
        return split_list(self.sign_in_proxies)

    @property
    def sign_in_scopes_by_group(self) -> dict[str, frozenset[Scope]]:
        """The scopes of each group of signed-in users; those of `*` belong to all of them."""
        scopes: dict[str, frozenset[Scope]] = {}
        for entry in split_list(self.sign_in_scopes):
            group, _, scope = entry.rpartition(":")
            scopes[group] = scopes.get(group, frozenset()) | {Scope(scope)}
        return scopes

    @property
    def proxy_addresses(self) -> list[str]:
        """Addresses and networks of trusted reverse proxies."""
        return split_list(self.trusted_proxies)
