"""Programs and browsers that use a console over plain HTTP and WebSockets."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
from collections.abc import AsyncIterator
from typing import Any

from websockets.asyncio.client import connect

PASSWORD = "correct horse"


class Answer:
    def __init__(self, status: int, headers: dict[str, str], body: bytes) -> None:
        self.status, self.headers, self.body = status, headers, body

    @property
    def json(self) -> Any:
        return json.loads(self.body)


class Programs:
    """Programs and browsers before a console. tokens: of its users."""

    def __init__(self, at: str, tokens: dict[str, str] | None = None) -> None:
        self.at, self.host, self.tokens = at, at.partition("://")[2], tokens or {}

    async def ask(self, method: str, path: str, body: Any = None, user: str | None = None, **headers: str) -> Answer:
        """Send one request over a connection of its own, with the token of a user."""
        if user is not None:
            headers["Authorization"] = f"Bearer {self.tokens[user]}"

        def exchange() -> Answer:
            connection = http.client.HTTPConnection(self.host, timeout=10)
            with contextlib.closing(connection):
                content = body if isinstance(body, bytes) else json.dumps(body).encode() if body is not None else None
                connection.request(method, path, content, {"Host": self.host, **headers})
                answer = connection.getresponse()
                return Answer(answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read())

        return await asyncio.to_thread(exchange)

    async def log_in(self, user: str, password: str = PASSWORD, **headers: str) -> Answer:
        body = {"user": user, "password": password}
        return await self.ask("POST", "/api/login", body, Origin=self.at, **headers)

    async def browser(self, user: str) -> dict[str, str]:
        """Log a browser in; give the headers of its requests."""
        answer = await self.log_in(user)
        assert answer.status == 200, answer.body
        cookie = answer.headers["set-cookie"].partition(";")[0]
        return {"Cookie": cookie, "Origin": self.at, "X-Zbridge-Csrf": answer.json["csrf"]}

    @contextlib.asynccontextmanager
    async def page(self, path: str = "/socket", **headers: str) -> AsyncIterator[Any]:
        options: dict[str, Any] = {"origin": self.at, "proxy": None, "additional_headers": headers}
        async with connect(f"ws://{self.host}{path}", **options) as opened:
            yield opened
