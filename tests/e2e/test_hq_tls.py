"""An HQ program behind a tunnel drives through a listener that speaks TLS; nobody else gets that far."""

from __future__ import annotations

import contextlib
import socket
import ssl
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.certificates import Authority
from tests.e2e.conftest import HOST, Bench, Gateway, device, until
from tests.e2e.rigs.hq_programs import tcpudp_by_tcp
from tests.ports import free_port


@contextlib.contextmanager
def tunnel(context: ssl.SSLContext, port: int) -> Iterator[socket.socket]:
    """Be what stunnel is on the machine of an HQ program: plain bytes here, TLS to the listener."""
    here, there = socket.socketpair()
    with here, there, context.wrap_socket(socket.create_connection((HOST, port)), server_hostname="localhost") as far:

        def carry(read: socket.socket, write: socket.socket) -> None:
            with contextlib.suppress(OSError):
                while data := read.recv(4096):
                    write.sendall(data)

        ways = [threading.Thread(target=carry, args=way) for way in ((there, far), (far, there))]
        for way in ways:
            way.start()
        try:
            yield here
        finally:
            for end in (here, far):
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)
            for way in ways:
                way.join()


def test_a_program_behind_a_tunnel_drives_and_one_without_certificate_or_network_does_not(
    bench: Bench, tmp_path: Path
) -> None:
    authority = Authority(tmp_path / "authority")
    own, desk = authority.issue("gateway.g1"), authority.issue("viewer.desk")
    port, closed = free_port(), free_port()
    tls = f'tls = {{ certificate = "{own}/certificate.pem", key = "{own}/key.pem", ca = "{authority.ca}" }}\n'
    listeners = f"""
[[hq]]
name = "desk"
protocol = "tcpudp"
listen = "tls://{HOST}:{port}"
handshake_s = 1.0
{tls}options = {{ udp = false }}
[[hq]]
name = "closed"
protocol = "tcpudp"
listen = "tcp://{HOST}:{closed}"
allow = ["10.0.0.0/8"]
"""
    gateway = Gateway(bench.stack, tmp_path / "r1.toml", bench.endpoint, device(bench.simulator()), listeners)
    until(lambda: gateway.listens(2))
    assert f"HQ programs connect at tls://{HOST}:{port}" in gateway.log
    context = ssl.create_default_context(cafile=str(authority.ca))
    silent, stranger = socket.create_connection((HOST, port)), socket.create_connection((HOST, port))
    with silent, stranger:
        stranger.sendall(b"3|9|0|0|0;" * 10)
        nameless = context.wrap_socket(socket.create_connection((HOST, port)), server_hostname="localhost")
        with nameless, pytest.raises(ssl.SSLError, match="CERTIFICATE_REQUIRED"):
            nameless.recv(1)
        context.load_cert_chain(desk / "certificate.pem", desk / "key.pem")
        with tunnel(context, port) as program:
            move = tcpudp_by_tcp(program)

            def drives() -> bool:
                move(0)
                time.sleep(0.1)
                move(1)
                time.sleep(0.1)
                return (bench.fleet.last("r1/control").get("holder") or "").startswith("hq.desk.")

            until(drives, what="the lease")
        silent.settimeout(10.0)
        until(lambda: silent.recv(64) == b"", what="the end of the one that says nothing")
    for _ in range(3):
        with socket.create_connection((HOST, closed)) as outside:
            outside.settimeout(5.0)
            assert outside.recv(64) == b""
    with socket.socket(type=socket.SOCK_DGRAM) as datagrams:
        datagrams.sendto(b"\x03\x00\x00\x00\x01\x05", (HOST, closed))
        datagrams.settimeout(0.2)
        with pytest.raises(TimeoutError):
            datagrams.recv(64)
    until(lambda: bench.fleet.last("r1/control").get("holder") is None)
    log = gateway.end()
    assert " gone: TLS: " in log, log
    assert log.count("turned away (1 so far): its network is not allowed") == 1, log
    assert "2 more turned away: its network is not allowed" in log, log
