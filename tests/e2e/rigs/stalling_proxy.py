"""An HTTP proxy on loopback whose connections can be stalled, each direction alone: TCP keeps what is sent meanwhile.

A browser that uses it keeps the console's own address in its Host and Origin.
"""

from __future__ import annotations

import contextlib
import socket
import threading

from tests.ports import HOST


class StallingProxy:
    """Serves ``CONNECT`` and plain requests; ``up`` is from the browser to the console."""

    def __init__(self) -> None:
        self.flows = {"up": threading.Event(), "down": threading.Event()}
        for flow in self.flows.values():
            flow.set()
        self._server = socket.create_server((HOST, 0))
        self.address = f"http://{HOST}:{self._server.getsockname()[1]}"
        self._sockets = [self._server]
        threading.Thread(target=self._accept, daemon=True).start()

    def stall(self, *directions: str) -> None:
        """Pass nothing on in these directions until :meth:`heal`."""
        for direction in directions:
            self.flows[direction].clear()

    def heal(self) -> None:
        """Pass on what waited, all at once."""
        for flow in self.flows.values():
            flow.set()

    def close(self) -> None:
        self.heal()
        for each in self._sockets:
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._server.accept()
                near.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                threading.Thread(target=self._serve, args=(near,), daemon=True).start()

    def _serve(self, near: socket.socket) -> None:
        with contextlib.suppress(OSError):
            head = b""
            while b"\r\n\r\n" not in head:
                head += near.recv(65536)
            method, target, _ = head.decode("latin-1").split(" ", 2)
            address = target.removeprefix("http://").partition("/")[0]
            host, _, port = address.rpartition(":")
            far = socket.create_connection((host, int(port)))
            far.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._sockets += [near, far]
            if method == "CONNECT":
                near.sendall(b"HTTP/1.1 200 Connected\r\n\r\n")
            else:
                far.sendall(_in_origin_form(head, address))
            for source, sink, direction in ((near, far, "up"), (far, near, "down")):
                arguments = (source, sink, direction, address)
                threading.Thread(target=self._pass_on, args=arguments, daemon=True).start()

    def _pass_on(self, source: socket.socket, sink: socket.socket, direction: str, address: str) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                self.flows[direction].wait()
                sink.sendall(_in_origin_form(data, address) if direction == "up" else data)
            sink.shutdown(socket.SHUT_WR)


def _in_origin_form(request: bytes, address: str) -> bytes:
    """Write the target of a request as servers expect it: without its host."""
    return request.replace(b" http://" + address.encode() + b"/", b" /", 1)
