"""What every request must fulfil, and what every answer says: a page of another site reaches nothing here.

A name that an attacker's DNS turns to this machine is refused by Host, a script of another page by Origin.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from zbridge.metrics import Metrics

_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
ANSWERED: Mapping[str, str] = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-cache",
}
_REFUSED = 1008
"""The close code of a socket that is refused: against the policy."""


class Guard:
    """Lets through what comes from our own pages, and from programs. origins: of our pages, ``scheme://host:port``."""

    def __init__(self, app: ASGIApp, origins: frozenset[str], metrics: Metrics) -> None:
        self._app = app
        self._count = metrics.count("console_requests_refused", status="403")
        self._origins = origins
        self._hosts = frozenset(origin.partition("://")[2] for origin in origins)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if (why := self._refused(scope)) is None:
            await self._app(scope, receive, _with_headers(send))
            return
        self._count.value += 1
        if scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": _REFUSED, "reason": why})
        else:
            await PlainTextResponse(f"{why}\n", 403)(scope, receive, _with_headers(send))

    def _refused(self, scope: Scope) -> str | None:
        """Return why a request is refused; None if it is not."""
        headers = Headers(scope=scope)
        if headers.get("host", "") not in self._hosts:
            return f"expected Host: {' or '.join(sorted(self._hosts))}"
        if scope["type"] == "http" and scope["method"] in ("GET", "HEAD"):
            return None
        if headers.get("origin") in self._origins or (scope["type"] == "http" and _is_program(headers)):
            return None
        return "expected the Origin of this console's own pages"


def _is_program(headers: Headers) -> bool:
    """Return whether no browser sent a request: they name the page that makes them send one."""
    return not any(name in headers for name in ("origin", "cookie", "sec-fetch-site"))


def _with_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers: Any = MutableHeaders(scope=message)
            for name, value in ANSWERED.items():
                headers.setdefault(name, value)
        await send(message)

    return sending
