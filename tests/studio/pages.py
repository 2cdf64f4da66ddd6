"""Serves the viewer's page, its files, its layout and a recording, on loopback."""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
LAYOUT = ROOT / "deploy" / "foxglove" / "zbridge.json"
_KINDS = {".html": "text/html", ".js": "text/javascript", ".json": "application/json", ".wasm": "application/wasm"}


@contextlib.contextmanager
def serve_pages(modules: Path, port: int, recordings: Path | None) -> Iterator[None]:
    """Serve ``/`` and what it needs, and the recordings of a folder (``/recording.mcap``) by ranges."""
    fixed = {
        "/": HERE / "page.html",
        "/react.js": modules / "react" / "umd" / "react.production.min.js",
        "/react-dom.js": modules / "react-dom" / "umd" / "react-dom.production.min.js",
        "/layout.json": LAYOUT,
    }
    assets = modules / "@foxglove" / "studio-base" / "assets"

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self._answer(body=True)

        def do_HEAD(self) -> None:
            self._answer(body=False)

        def _answer(self, *, body: bool) -> None:
            path = self.path.partition("?")[0]
            file = fixed.get(path) or assets / Path(path).name
            if recordings is not None and path.endswith(".mcap"):
                file = recordings / Path(path).name
            if not file.is_file():
                self.send_error(404)
                return
            data = file.read_bytes()
            if file.suffix == ".js":
                data = data.replace(b"foxglove.websocket.v1", b"foxglove.sdk.v1")
            begin, end, status = 0, len(data), 200
            if ranged := re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", "")):
                begin, status = int(ranged[1]), 206
                end = int(ranged[2]) + 1 if ranged[2] else end
            self.send_response(status)
            self.send_header("Content-Type", _KINDS.get(file.suffix, "application/octet-stream"))
            self.send_header("Content-Length", str(len(data[begin:end])))
            self.send_header("Accept-Ranges", "bytes")
            if status == 206:
                self.send_header("Content-Range", f"bytes {begin}-{end - 1}/{len(data)}")
            self.end_headers()
            if body:
                self.wfile.write(data[begin:end])

        def log_message(self, format: str, *args: object) -> None:
            """Say nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield
    finally:
        server.shutdown()
