"""The URLs of a listening server."""

from __future__ import annotations

import re
import signal

import pytest
import uvicorn

from services.http_server import lan_url, reachable_url, stop_on_signals


def test_lan_url_is_that_of_a_network_address_and_none_for_loopback() -> None:
    assert lan_url("192.168.1.23", 8000) == "http://192.168.1.23:8000"
    for host in ("127.0.0.1", "::1", "localhost"):
        assert lan_url(host, 8000) is None


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_a_wildcard_address_is_replaced_by_one_that_others_can_open(host: str) -> None:
    url = lan_url(host, 8000)
    # None on a machine without any network.
    assert url is None or re.fullmatch(r"http://(?!127\.|0\.)[\d.]+:8000", url)
    assert reachable_url(host, 8000) in ("http://127.0.0.1:8000", "http://[::1]:8000")


@pytest.mark.parametrize("under_nohup", [False, True])
def test_a_closed_terminal_stops_the_server_unless_hangups_are_ignored(under_nohup: bool) -> None:
    server = uvicorn.Server(uvicorn.Config("none", log_config=None))
    ignored = signal.SIG_IGN if under_nohup else signal.SIG_DFL
    previous = signal.signal(signal.SIGHUP, ignored)
    try:
        with stop_on_signals(server):
            if under_nohup or signal.getsignal(signal.SIGHUP) is not signal.SIG_DFL:
                signal.raise_signal(signal.SIGHUP)
        assert server.should_exit is not under_nohup
    finally:
        signal.signal(signal.SIGHUP, previous)
