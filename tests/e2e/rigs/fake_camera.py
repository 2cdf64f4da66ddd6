"""A robot's camera for end-to-end tests: the standard library's HTTP server, as on legacy robots.

``/stream.mjpg`` answers as the example "Web streaming" of the Raspberry Pi's camera library does.
"""

from __future__ import annotations

import contextlib
import select
import socket
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class FakeCamera:
    """Shows each of its clients every picture that it is given. answers: raw answers, each for one connection."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.requests: list[bytes] = []
        """The heads of all requests."""
        self.answers: list[bytes] = []
        self.clients = 0
        self.written: list[bytes] = []
        """What each client was sent; the last one is the newest."""
        self._pictures: list[bytes] = []
        self._changed = threading.Condition()
        self._server: ThreadingHTTPServer | None = None
        self._sockets: set[socket.socket] = set()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/stream.mjpg"

    def start(self) -> None:
        camera = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                camera._serve(self)

            def log_message(self, *_: object) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", self.port), Handler)
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True).start()

    def stop(self) -> None:
        """Die: nobody is answered, and every connection ends."""
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
            self._server = None
        for client in tuple(self._sockets):
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)

    def show(self, picture: bytes) -> None:
        with self._changed:
            self._pictures.append(picture)
            self._changed.notify_all()

    def _serve(self, handler: BaseHTTPRequestHandler) -> None:
        self.requests.append(handler.raw_requestline + str(handler.headers).encode())
        client = handler.connection
        self._sockets.add(client)
        with self._changed:
            self.clients += 1
            seen = len(self._pictures)
        try:
            with contextlib.suppress(OSError):
                if self.answers:
                    client.sendall(self.answers.pop(0))
                    client.recv(1)
                else:
                    self._stream(handler, seen)
        finally:
            self._sockets.discard(client)
            with self._changed:
                self.clients -= 1

    def _stream(self, handler: BaseHTTPRequestHandler, seen: int) -> None:
        handler.send_response(200)
        handler.send_header("Age", "0")
        handler.send_header("Cache-Control", "no-cache, private")
        handler.send_header("Pragma", "no-cache")
        handler.send_header("Content-Type", "multipart/x-mixed-replace; boundary=FRAME")
        head = b"".join(handler._headers_buffer) + b"\r\n"
        handler.end_headers()
        self.written.append(head)
        while True:
            with self._changed:
                self._changed.wait_for(lambda seen=seen: len(self._pictures) > seen, 0.05)
                if _has_gone(handler.connection):
                    return
                if len(self._pictures) <= seen:
                    continue
                picture = self._pictures[seen]
                seen += 1
            handler.wfile.write(b"--FRAME\r\n")
            handler.send_header("Content-Type", "image/jpeg")
            handler.send_header("Content-Length", str(len(picture)))
            header = b"".join(handler._headers_buffer) + b"\r\n"
            handler.end_headers()
            handler.wfile.write(picture)
            handler.wfile.write(b"\r\n")
            self.written[-1] += b"--FRAME\r\n" + header + picture + b"\r\n"


def _has_gone(client: socket.socket) -> bool:
    """Tell whether a client that sends nothing has ended its connection."""
    readable, _, _ = select.select([client], [], [], 0)
    return bool(readable) and client.recv(1) == b""
