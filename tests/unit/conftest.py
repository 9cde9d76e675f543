"""Shared fixtures: of the tests of the command line, and a server of files."""

import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest


@pytest.fixture
def cloud_files(tmp_path):
    """A 2D pair with a known pose: 12 points, rotated by 0.4 rad, scaled by 1.2, translated."""
    source = np.random.default_rng(3).random((12, 2))
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    target = 1.2 * source @ turn.T + [5.0, -2.0]
    np.savetxt(tmp_path / "source.txt", source)
    np.savez(tmp_path / "target.npz", a=target, b=target[:6])
    return tmp_path / "source.txt", f"{tmp_path / 'target.npz'}:a"


@pytest.fixture
def call(cloud_files):
    """The arguments of a good call; others are appended."""
    return ["register", *cloud_files, "--model", "similarity2d", "--n-inliers", "0.8"]


@pytest.fixture
def sweep_call(cloud_files):
    return ["sweep", *cloud_files, "--model", "similarity2d", "--n-inliers", "6:12:3"]


@pytest.fixture
def serve():
    """Serve a folder over loopback http; returns its address and the paths asked for."""
    servers = []

    def start(folder):
        asked = []

        class Handler(SimpleHTTPRequestHandler):
            def log_message(self, *arguments):
                asked.append(self.path)

        server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(folder)))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        servers.append(server)
        return f"http://127.0.0.1:{server.server_port}", asked

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()
