"""Where a webhook may lead, and that it is led nowhere else."""

from __future__ import annotations

import ipaddress
import socket
from typing import Any

import pytest

from services.steward.webhooks import sign_webhook
from shared.errors import PlacewiseError, Unprocessable
from shared.security.webhook_targets import (
    WebhookTarget,
    is_public_address,
    parse_webhook_url,
    resolve_webhook_target,
)


@pytest.mark.parametrize(
    "address", ["8.8.8.8", "1.1.1.1", "2606:4700:4700::1111", "64:ff9b::808:808"]
)
def test_public_addresses_are_allowed(address: str) -> None:
    assert is_public_address(ipaddress.ip_address(address))


@pytest.mark.parametrize(
    "address",
    [
        "127.0.0.1",
        "127.8.8.8",
        "0.0.0.0",
        "10.0.0.5",
        "172.16.3.4",
        "192.168.1.1",
        "169.254.169.254",  # metadata of most clouds
        "100.100.100.200",  # Alibaba's
        "100.64.0.1",
        "192.0.0.192",  # Oracle's
        "198.18.0.1",
        "224.0.0.1",
        "240.0.0.1",
        "255.255.255.255",
        "::",
        "::1",
        "fe80::1",
        "fe80::1%eth0",
        "fc00::1",
        "fd00:ec2::254",  # Amazon's
        "fec0::1",
        "ff02::1",
        "2001:db8::1",
        "::ffff:127.0.0.1",
        "::ffff:169.254.169.254",
        "64:ff9b::7f00:1",
        "64:ff9b::a9fe:a9fe",
        "64:ff9b:1::a00:1",
        "2002:7f00:1::",
        "2002:a9fe:a9fe::",
        "2001:0:4136:e378:8000:63bf:f5ff:fffe",  # Teredo of 10.0.0.1
        "::127.0.0.1",
    ],
)
def test_private_addresses_are_refused_in_every_notation(address: str) -> None:
    assert not is_public_address(ipaddress.ip_address(address))


@pytest.mark.parametrize(
    "host",
    ["localhost", "127.0.0.1", "127.1", "2130706433", "0x7f000001", "0177.0.0.1", "[::1]", "0"],
)
def test_spellings_of_loopback_are_loopback(host: str) -> None:
    target = parse_webhook_url(f"https://{host}/", allow_private=False)
    with pytest.raises(Unprocessable) as caught:
        resolve_webhook_target(target, allow_private=False)
    assert caught.value.code == "webhook_address_forbidden"
    assert resolve_webhook_target(target, allow_private=True) in ("127.0.0.1", "::1", "0.0.0.0")


def test_a_host_with_one_private_address_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def both(host: str, port: int, **options: Any) -> Any:
        return [
            (socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, port))
            for address in ("8.8.8.8", "10.0.0.1")
        ]

    monkeypatch.setattr(socket, "getaddrinfo", both)
    with pytest.raises(Unprocessable, match=r"10\.0\.0\.1"):
        resolve_webhook_target(
            WebhookTarget("https", "both.example", 443, "/"), allow_private=False
        )


def test_an_unresolvable_host_differs_from_a_private_one() -> None:
    with pytest.raises(PlacewiseError) as caught:
        resolve_webhook_target(
            WebhookTarget("https", "no-such-name.invalid", 443, "/"), allow_private=False
        )
    assert caught.value.code == "webhook_name_unknown"


@pytest.mark.parametrize(
    "url",
    [
        "",
        "example.com/hook",
        "http://example.com/",
        "ftp://example.com/",
        "file:///etc/passwd",
        "gopher://example.com/",
        "https://",
        "https:///path",
        "https://user@example.com/",
        "https://user:secret@example.com/",
        "https://example.com/#part",
        "https://example.com:0/",
        "https://example.com:99999/",
        "https://example.com/a b",
        "https://example.com/\r\nHost: evil",
        "https://[::1/",
        "https://exämple.com/",
        "https://example.com/" + "x" * 2000,
    ],
)
def test_invalid_webhook_urls_are_refused(url: str) -> None:
    with pytest.raises(Unprocessable) as caught:
        parse_webhook_url(url, allow_private=False)
    assert caught.value.code == "invalid_field"
    assert not url.startswith("http://") or "WEBHOOK_PRIVATE_ADDRESSES" in caught.value.detail


def test_a_target_has_what_a_request_needs() -> None:
    target = parse_webhook_url("https://Example.com:8443/a/b?c=d", allow_private=False)
    assert target == WebhookTarget("https", "example.com", 8443, "/a/b?c=d")
    assert target.host_header == "example.com:8443"
    assert parse_webhook_url("https://example.com", allow_private=False).path == "/"
    assert parse_webhook_url("http://[::1]:80/", allow_private=True).host_header == "[::1]"


def test_the_signature_is_that_of_the_specification() -> None:
    # The example of the Standard Webhooks libraries.
    secret = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"
    body = '{"test": 2432232314}'
    assert sign_webhook(secret, "msg_p5jXN8AQM9LWM0D4loKWxJek", 1614265330, body) == (
        "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE="
    )
