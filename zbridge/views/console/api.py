"""The console for programs: HTTP with JSON, and what pages need to log in. ``OPERATIONS`` is the whole interface.

Each operation names the right that it needs. A request without a caller is answered 401, one without the right 403. A
changing request of a browser must carry the token of its login; one of a program carries its own token and no cookie.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from typing import Annotated, Any

import msgspec
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route

from zbridge.errors import BusError, PayloadError, RateLimited, Refused
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.topics import KeySpace, Topic, is_name
from zbridge.version import __version__
from zbridge.views.console.console import Console
from zbridge.views.console.orders import Order
from zbridge.views.console.rights import Action, Caller

BODY_BYTES = 4096
BODY_S = 10.0
"""Longest time that the body of a request may take."""
REFUSED_S = 0.2
"""How long a refused login waits for its answer."""
STREAM_S = 2.0
"""Longest wait for the next message of a stream."""
_encode = msgspec.json.Encoder(enc_hook=lambda array: array.tolist()).encode
"""Writes arrays as lists, what is no finite number as null, bytes as base64."""
_Text = Annotated[str, msgspec.Meta(max_length=1000)]
_READ: Mapping[str, Topic] = {
    "status": topics.STATUS,
    "control": topics.CONTROL,
    "map": topics.MAP,
    "pose": topics.POSE,
    "scan": topics.SCAN,
}
"""What can be read of a robot: its states, and the next message of its streams."""


class LoginRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Who logs in."""

    user: _Text
    password: _Text


class UnlatchRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Whose latched stops are released: of one robot, or of the fleet."""

    robot: _Text = ""


class Operation(msgspec.Struct, frozen=True):
    """One path and method. right: what the caller needs; None: anybody may. body: what the request must hold."""

    method: str
    path: str
    summary: str
    answer: str
    handle: Callable[[Api, Request, Caller, Any], Awaitable[Response]]
    right: Action | None = None
    body: Any = None


class Api:
    """Answers the operations."""

    def __init__(self, console: Console) -> None:
        self.console = console

    def __repr__(self) -> str:
        return f"<Api {len(OPERATIONS)} operations>"

    def routes(self) -> list[Route]:
        """Return the routes of all operations."""
        by_path: dict[str, dict[str, Operation]] = {}
        for operation in OPERATIONS:
            by_path.setdefault(operation.path, {})[operation.method] = operation
        return [Route(path, self._endpoint(found), methods=[*found]) for path, found in by_path.items()]

    def _endpoint(self, operations: Mapping[str, Operation]) -> Callable[[Request], Awaitable[Response]]:
        async def answer(request: Request) -> Response:
            operation = operations["GET" if request.method == "HEAD" else request.method]
            response = await self._answer(operation, request)
            if response.status_code >= 400:
                self.console.metrics.count("console_requests_refused", status=str(response.status_code)).value += 1
            return response

        return answer

    async def _answer(self, operation: Operation, request: Request) -> Response:
        console, caller = self.console, self.console.callers.recognise(request.scope)
        if operation.right is None and caller is None:
            caller = Caller("", "", frozenset(), request.client.host if request.client is not None else "")
        if caller is None:
            return problem(401, "log in, or send a token: Authorization: Bearer ...")
        if operation.right is not None and not caller.may(operation.right):
            return problem(403, caller.refusal(operation.right))
        changes = operation.method != "GET" and operation.right is not None
        if changes and console.callers.is_forged(caller, request.scope):
            return problem(403, "the request lacks the token of this login")
        robot = request.path_params.get("robot", "")
        if robot and not is_name(robot):
            return problem(404, f"{robot[:60]!r} is no robot's name")
        try:
            body = await _read(operation.body, request) if operation.body is not None else None
        except (msgspec.MsgspecError, TimeoutError, ClientDisconnect) as error:
            return problem(400, f"{error}"[:200] or "the body did not come in time")
        try:
            return await operation.handle(self, request, caller, body)
        except RateLimited as refusal:
            return problem(429, str(refusal))

    # Logins

    async def log_in(self, request: Request, caller: Caller, body: LoginRequest) -> Response:
        console = self.console
        if not console.callers.with_login:
            return problem(404, "this console has no users: everybody may use it")
        try:
            secret, caller = await console.callers.log_in(body.user, body.password, caller.address)
        except Refused as refusal:
            limited = isinstance(refusal, RateLimited)
            if not limited:
                user = body.user if console.callers.has(body.user) else ""  # else it may be a password
                caller = msgspec.structs.replace(caller, user=user)
                console.journal.note(caller, "login", result=str(refusal), refused=True)
            await asyncio.sleep(REFUSED_S)  # who tries passwords must not delay who drives
            return problem(429 if limited else 401, str(refusal))
        console.journal.note(caller, "login", result="ok")
        return answered(self._me(caller), cookie=console.callers.cookie(secret))

    async def log_out(self, request: Request, caller: Caller, body: None) -> Response:
        self.console.callers.log_out(caller)
        self.console.journal.note(caller, "logout", result="ok")
        return answered({"ok": True}, cookie=self.console.callers.cookie(""))

    async def me(self, request: Request, caller: Caller, body: None) -> Response:
        return answered(self._me(caller))

    def _me(self, caller: Caller) -> dict[str, Any]:
        csrf = self.console.callers.csrf(caller)
        return {"user": caller.user, "role": caller.role, "may": sorted(caller.rights), "csrf": csrf}

    # Robots

    async def robots(self, request: Request, caller: Caller, body: None) -> Response:
        return answered({"robots": list(self.console.feed.rows.values())})

    async def robot(self, request: Request, caller: Caller, body: None) -> Response:
        row = self.console.feed.rows.get(request.path_params["robot"])
        return answered(row) if row is not None else problem(404, "no such robot")

    async def events(self, request: Request, caller: Caller, body: None) -> Response:
        if self.console.is_full(caller):
            return problem(503, "as many follow the fleet as may")
        return StreamingResponse(self._events(caller), media_type="text/event-stream")

    async def _events(self, caller: Caller) -> AsyncIterator[bytes]:
        with self.console.following(caller) as follower:
            while self.console.callers.is_valid(caller):
                yield b"data: " + await follower.next() + b"\n\n"

    async def stop(self, request: Request, caller: Caller, body: None) -> Response:
        return await _report(self.console.orders.stop(caller, request.path_params["robot"]))

    async def stop_all(self, request: Request, caller: Caller, body: None) -> Response:
        return await _report(self.console.orders.stop_all(caller))

    async def unlatch(self, request: Request, caller: Caller, body: UnlatchRequest) -> Response:
        needed = Action.UNLATCH if body.robot else Action.UNLATCH_FLEET
        if not caller.may(needed):
            return problem(403, caller.refusal(needed))
        if body.robot and not is_name(body.robot):
            return problem(404, "no such robot")
        if body.robot:
            return await _report(self.console.orders.unlatch(caller, body.robot))
        return await _report(self.console.orders.release_all(caller))

    async def metrics(self, request: Request, caller: Caller, body: None) -> Response:
        return Response(self.console.metrics.exposition(), media_type="text/plain; version=0.0.4")

    async def document(self, request: Request, caller: Caller, body: None) -> Response:
        return answered(openapi())

    async def message(self, request: Request, name: str) -> Response:
        """Answer with the last value of a state, or the next message of a stream."""
        topic = _READ[name]
        key = KeySpace(self.console.fleet.realm, request.path_params["robot"]).key(topic.path)
        payload = await (self._last(key) if topic.qos.keeps_last else self._next(key))
        if payload is None:
            return problem(404, f"{request.path_params['robot']} publishes no {name}, or not within {STREAM_S:g} s")
        try:
            return answered(payloads.decode(topic.message, payload))
        except PayloadError as error:
            return problem(502, f"what the robot's gateway published cannot be read: {error}"[:200])

    async def _last(self, key: str) -> bytes | None:
        with contextlib.suppress(BusError):
            for answer in await self.console.bus.ask(key):
                if answer.error is None:
                    return answer.payload
        return None

    async def _next(self, key: str) -> bytes | None:
        came: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()

        def take(sample: Any) -> None:
            if not came.done():
                came.set_result(sample.payload)

        with contextlib.closing(self.console.bus.subscribe(key, take)), contextlib.suppress(TimeoutError):
            async with asyncio.timeout(STREAM_S):
                return await came
        return None


def _reader(name: str) -> Callable[[Api, Request, Caller, Any], Awaitable[Response]]:
    async def read(api: Api, request: Request, caller: Caller, body: Any) -> Response:
        return await api.message(request, name)

    return read


async def _report(order: Order) -> Response:
    """Answer with what came of something that others may have begun too, and that a STOP ALL replaces."""
    try:
        return answered(await asyncio.shield(order))
    except asyncio.CancelledError:
        if not order.cancelled():
            raise
        return problem(409, "a STOP ALL has begun meanwhile: its answer counts")


async def _read(kind: Any, request: Request) -> Any:
    """Read the body of a request; raise MsgspecError, or TimeoutError. An empty body is an empty object."""
    content = b""
    async with asyncio.timeout(BODY_S):
        async for chunk in request.stream():
            content += chunk
            if len(content) > BODY_BYTES:
                raise msgspec.ValidationError(f"a body of more than {BODY_BYTES} bytes")
    return msgspec.json.decode(content or b"{}", type=kind)


def answered(value: Any, *, cookie: str | None = None) -> Response:
    """Make an answer of JSON that no cache keeps."""
    headers = {"cache-control": "no-store"} | ({"set-cookie": cookie} if cookie is not None else {})
    return Response(_encode(value), media_type="application/json", headers=headers)


def problem(status: int, text: str) -> Response:
    """Make an answer that says what is wrong."""
    headers = {"cache-control": "no-store"} | ({"www-authenticate": "Bearer"} if status == 401 else {})
    return Response(_encode({"error": text}), status, media_type="application/json", headers=headers)


def openapi() -> dict[str, Any]:
    """Describe the operations as an OpenAPI 3.1 document."""
    paths: dict[str, dict[str, Any]] = {}
    for each in OPERATIONS:
        described: dict[str, Any] = {"summary": each.summary, "responses": {"200": {"description": each.answer}}}
        if each.right is not None:
            described["x-right"] = each.right.value
            described["responses"] |= {
                "401": {"description": "nobody is logged in"},
                "403": {"description": "no right"},
            }
        else:
            described["security"] = []
        if "{robot}" in each.path:
            name = {"name": "robot", "in": "path", "required": True, "schema": {"type": "string"}}
            described["parameters"] = [name]
        if each.body is not None:
            (schema,), _ = msgspec.json.schema_components([each.body], ref_template="#/components/schemas/{name}")
            described["requestBody"] = {"content": {"application/json": {"schema": schema}}}
        paths.setdefault(each.path, {})[each.method.lower()] = described
    bodies = [each.body for each in OPERATIONS if each.body is not None]
    _, schemas = msgspec.json.schema_components(bodies, ref_template="#/components/schemas/{name}")
    schemes = {"token": {"type": "http", "scheme": "bearer"}}
    return {
        "openapi": "3.1.0",
        "info": {"title": "zbridge console", "version": __version__},
        "security": [{"token": []}],
        "paths": paths,
        "components": {"schemas": schemas, "securitySchemes": schemes},
    }


_REPORT = "`text`: what came of it, for people; `good`: whether nothing is left to be done"
_ROBOT = "/api/robots/{robot}"
OPERATIONS: tuple[Operation, ...] = (
    Operation(
        "POST", "/api/login", "log a browser in", "who logged in; sets the cookie", Api.log_in, body=LoginRequest
    ),
    Operation("POST", "/api/logout", "log a browser out", "`ok`", Api.log_out, Action.LOOK),
    Operation("GET", "/api/me", "who asks, and what they may do", "`user`, `role`, `may`, `csrf`", Api.me, Action.LOOK),
    Operation("GET", "/api/robots", "all robots", "`robots`: a row of each", Api.robots, Action.LOOK),
    Operation("GET", _ROBOT, "one robot", "its row", Api.robot, Action.LOOK),
    *(
        Operation("GET", f"{_ROBOT}/{name}", f"the {name} of a robot", "the fleet message", _reader(name), Action.LOOK)
        for name in _READ
    ),
    Operation(
        "GET", "/api/events", "what changes, as server-sent events", "all rows, then changes", Api.events, Action.LOOK
    ),
    Operation("POST", f"{_ROBOT}/stop", "stop one robot", _REPORT, Api.stop, Action.STOP),
    Operation("POST", "/api/stop", "latch a stop of the fleet", _REPORT, Api.stop_all, Action.STOP),
    Operation(
        "POST", "/api/unlatch", "release the fleet, or one robot", _REPORT, Api.unlatch, Action.UNLATCH, UnlatchRequest
    ),
    Operation("GET", "/metrics", "what was refused and dropped", "for Prometheus", Api.metrics, Action.LOOK),
    Operation("GET", "/api/openapi.json", "this document", "OpenAPI 3.1", Api.document),
)
