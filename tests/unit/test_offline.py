"""Tests cannot reach a network: neither this process nor its children."""

from __future__ import annotations

import socket
import subprocess
import sys
import urllib.request

import pytest

from tests import offline

OUTSIDE = "192.0.2.1"  # reserved for documentation: no machine has this address
CONNECT = "import socket, sys; socket.create_connection((sys.argv[1], 80), timeout=5)"


@pytest.mark.parametrize("url", [f"http://{OUTSIDE}/", "http://example.invalid/"])
def test_another_machine_is_refused_by_an_error_that_no_fallback_catches(url):
    with pytest.raises(offline.NetworkError, match=r"no test may use a network"):
        urllib.request.urlopen(url, timeout=5)


def test_datagrams_are_refused():
    datagrams = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    with datagrams as sender, pytest.raises(offline.NetworkError):
        sender.sendto(b"x", (OUTSIDE, 53))


def test_this_machine_is_not_refused():
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = server.getsockname()
        with socket.create_connection(address, timeout=5) as client:
            assert client.getpeername() == address
    assert socket.getaddrinfo("localhost", 80)


@pytest.mark.parametrize(
    ("host", "local"),
    [("127.0.0.1", True), ("127.8.0.1", True), ("::1", True), ("localhost", True), (b"127.0.0.1", True),
     ("/run/some.socket", True), (OUTSIDE, False), ("10.0.0.1", False), ("localhost.example", False),
     ("0.0.0.0", False), (b"example.invalid", False)],
)  # fmt: skip
def test_addresses_of_this_machine_are_known(host, local):
    assert offline.is_local(host) == local


def test_a_child_process_has_no_network():
    if not offline.is_isolated():
        pytest.skip("this user may not create a network namespace; only pytest itself is blocked")
    child = [sys.executable, "-c", CONNECT, OUTSIDE]
    done = subprocess.run(child, capture_output=True, text=True, timeout=30)
    assert "Network is unreachable" in done.stderr
