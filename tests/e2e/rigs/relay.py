"""A TCP relay that can be cut: what is sent meanwhile waits, as in a network that is cut without a word."""

from __future__ import annotations

import contextlib
import socket
import threading

from tests.ports import HOST


class Relay:
    """Passes everything on to a port of this machine, while it is not cut."""

    def __init__(self, port: int) -> None:
        self._to = port
        self._flows = threading.Event()
        self._flows.set()
        self._server = socket.create_server((HOST, 0))
        self.port = int(self._server.getsockname()[1])
        self._sockets = [self._server]
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """Pass nothing on until :meth:`heal`."""
        self._flows.clear()

    def heal(self) -> None:
        """Pass on what waited, and all that follows."""
        self._flows.set()

    def close(self) -> None:
        """End all connections."""
        self.heal()
        for each in self._sockets:
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._server.accept()
                far = socket.create_connection((HOST, self._to))
                self._sockets += [near, far]
                for source, sink in ((near, far), (far, near)):
                    threading.Thread(target=self._pass_on, args=(source, sink), daemon=True).start()

    def _pass_on(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                self._flows.wait()
                sink.sendall(data)
            sink.shutdown(socket.SHUT_WR)
