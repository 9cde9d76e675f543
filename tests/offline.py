"""No test reaches a network: every connection except to this machine is refused once this is imported.

It is refused twice. In this process, attempts raise an error, also in code that expects networks to fail.
Where the kernel admits it, this process moves to a network namespace that has only a loopback device,
which binds child processes of any kind as well.
"""

from __future__ import annotations

import ctypes
import fcntl
import ipaddress
import os
import socket
import struct
import sys
from pathlib import Path

_CLONE_NEWUSER, _CLONE_NEWNET = 0x10000000, 0x40000000
_SET_FLAGS, _IS_UP = 0x8914, 0x1  # of a network device
_EVENTS = ("socket.connect", "socket.sendto", "socket.sendmsg", "socket.getaddrinfo")


class NetworkError(RuntimeError):
    """A test tried to reach another machine; serve the data from 127.0.0.1 instead."""


def is_isolated() -> bool:
    """Whether loopback is the only network device, so that no process here can send anything."""
    try:
        lines = Path("/proc/self/net/dev").read_text(encoding="ascii").splitlines()[2:]
    except OSError:
        return False
    return [line.split(":")[0].strip() for line in lines] == ["lo"]


def _refuse(event: str, arguments: tuple[object, ...]) -> None:
    if event not in _EVENTS:
        return
    address = arguments[0] if event == "socket.getaddrinfo" else arguments[1]
    host = address[0] if isinstance(address, tuple) else address
    if host and not is_local(host):
        raise NetworkError(f"{event} to {host!r}: no test may use a network; see tests/offline.py")


def is_local(host: object) -> bool:
    """Whether an address is that of this machine, or of no machine: a path of a local socket."""
    if isinstance(host, bytes):
        host = host.decode("ascii", errors="replace")
    if not isinstance(host, str) or host.startswith(("/", "\0")):
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _move_to_a_namespace() -> None:
    """Move this thread, and what it starts later, to an empty network namespace, if that is allowed."""
    user, group = os.getuid(), os.getgid()
    flags = _CLONE_NEWNET if user == 0 else _CLONE_NEWNET | _CLONE_NEWUSER
    if sys.platform != "linux" or ctypes.CDLL(None).unshare(flags):
        return
    if user:
        Path("/proc/self/setgroups").write_text("deny")
        Path("/proc/self/uid_map").write_text(f"{user} {user} 1")
        Path("/proc/self/gid_map").write_text(f"{group} {group} 1")
    with socket.socket() as device:
        fcntl.ioctl(device, _SET_FLAGS, struct.pack("16sH14x", b"lo", _IS_UP))


sys.addaudithook(_refuse)
if not is_isolated():
    _move_to_a_namespace()
