"""Ports of this machine for tests and benchmarks."""

from __future__ import annotations

import contextlib
import os
import random
import socket

HOST = "127.0.0.1"
_PORTS = range(20_000, 32_000)
"""Below those that the kernel gives to connections."""
_WORKERS = 16
_given: set[int] = set()


def _own_ports() -> range:
    """Give the ports of this process: each worker of pytest-xdist has its own, as they know nothing of each other."""
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    return _PORTS if worker is None else _PORTS[int(worker.removeprefix("gw")) % _WORKERS :: _WORKERS]


def free_port() -> int:
    """Find a port, for TCP and UDP, that nobody is given by chance: what listens there may be away for a while."""
    while True:
        port = random.choice(_own_ports())
        if port in _given:
            continue
        _given.add(port)
        with contextlib.suppress(OSError), socket.socket() as tcp, socket.socket(type=socket.SOCK_DGRAM) as udp:
            tcp.bind((HOST, port))
            udp.bind((HOST, port))
            return port
