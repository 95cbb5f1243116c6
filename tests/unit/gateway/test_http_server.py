"""The URLs of a listening server."""

from __future__ import annotations

import re

import pytest

from services.http_server import lan_url, reachable_url


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost"])
def test_a_loopback_address_has_no_url_for_other_devices(host: str) -> None:
    assert lan_url(host, 8000) is None


def test_an_address_of_the_network_is_its_own_url() -> None:
    assert lan_url("192.168.1.23", 8000) == "http://192.168.1.23:8000"


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_a_wildcard_address_is_replaced_by_one_that_others_can_open(host: str) -> None:
    url = lan_url(host, 8000)
    # None on a machine without any network.
    assert url is None or re.fullmatch(r"http://(?!127\.|0\.)[\d.]+:8000", url)
    assert reachable_url(host, 8000) in ("http://127.0.0.1:8000", "http://[::1]:8000")
