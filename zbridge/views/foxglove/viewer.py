"""One viewer: reads its messages, asks the source to carry them out, and sends what waits for it.

A message that cannot be read or carried out is counted, and the person is told why; it ends nothing. A viewer that
sends more than ``RATE_HZ`` a second, or lets too many answers queue up, is closed. Knows no bus and no file.
"""

from __future__ import annotations

import asyncio
import math
from collections import Counter
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping
from typing import Any, Protocol

from zbridge.errors import BusError, ProtocolError, Refused, Unsupported, describe
from zbridge.fleet.printable import shown
from zbridge.log import Log
from zbridge.protocol.rate_limit import RateLimit
from zbridge.tasks import Tasks, race
from zbridge.views.foxglove import replies, requests
from zbridge.views.foxglove.outbox import ViewerOutbox
from zbridge.views.foxglove.requests import ClientChannel, ServiceCall
from zbridge.views.foxglove.source import ViewerSource

log = Log("zbridge.foxglove")

RATE_HZ = 500.0
"""Most messages a second of one viewer; one that sends more is closed."""
WARNINGS_HZ = 5.0
"""Most warnings a second; the rest are only counted."""
SEND_S = 30.0
"""A viewer that is stalled for so long is closed, by TimeoutError."""
CALLS = 8
"""Most calls of one viewer that are carried out at the same time."""
SUBSCRIPTIONS = 4096
"""Most subscriptions of one viewer."""
PUBLISHED = 64
"""Most channels on which one viewer publishes."""


class Overrun(Exception):
    """The viewer broke a limit and is ended."""


class ViewerConnection(Protocol):
    """A WebSocket connection, as a viewer needs it."""

    def __aiter__(self) -> AsyncIterator[str | bytes]:
        """Yield the messages of the viewer, until it is gone."""

    def send_now(self, message: bytes) -> bool:
        """Send a message without waiting; False if it would have to wait."""

    async def send(self, message: str | bytes) -> None:
        """Send a message; wait until there is room for the next."""


class Viewer:
    """A viewer of a source. name: shown to others as the driver. may_drive: whether its commands are carried out."""

    def __init__(
        self,
        name: str,
        source: ViewerSource,
        connection: ViewerConnection,
        *,
        may_drive: bool,
        clock: Callable[[], float],
    ) -> None:
        self.name = name
        self.may_drive = may_drive
        self.counts: Counter[str] = Counter()
        """Messages received (``said``), dropped and refused."""
        self._source = source
        self._hub = source.hub
        self._connection = connection
        self._clock = clock
        self._outbox = ViewerOutbox()
        self._filled = asyncio.Event()
        self._sending_since = math.inf
        self._rate = RateLimit(RATE_HZ)
        self._warned = RateLimit(WARNINGS_HZ)
        self._channels: dict[int, int] = {}
        """The channel of each subscription."""
        self._subscribed: set[int] = set()
        self._published: dict[int, ClientChannel] = {}
        self._calls = Tasks()
        self._watched: set[str] | None = None
        """Names of the parameters it watches: an empty set for all, None for none."""

    def __repr__(self) -> str:
        return f"<Viewer {self.name} {dict(self.counts)}>"

    async def run(self) -> None:
        """Serve the viewer until it is gone; raise Overrun or TimeoutError if it has to be ended."""
        self.say(self._source.info())
        self._hub.join(self)
        services = self._source.commands.services()
        if services:
            self.say(replies.advertise_services(services))
        self._source.greet(self)
        try:
            await race(self._read(), self._write(), self._watch_writing())
        finally:
            await self._calls.end()
            await self._leave()

    # To the viewer

    def say(self, message: str | bytes) -> None:
        self._outbox.say(message)
        self._filled.set()

    def show(self, subscription: int, message: bytes) -> None:
        """Send a message of a channel: at once where nothing waits, else the newest wins."""
        if self._outbox or not self._connection.send_now(message):
            self._outbox.show(subscription, message)
            self._filled.set()

    def ended(self, subscription: int) -> None:
        self._subscribed.discard(self._channels.pop(subscription, -1))
        self._outbox.forget(subscription)

    def warn(self, text: str) -> None:
        """Tell the person that something was not done, a few times a second at most."""
        if self._warned.take(self._clock()):
            self.say(replies.warning(shown(text)))

    def parameters_changed(self, values: Mapping[str, Any]) -> None:
        if self._watched is None:
            return
        watched = {name: value for name, value in values.items() if not self._watched or name in self._watched}
        if watched:
            self.say(replies.parameter_values(watched))

    async def _write(self) -> None:
        outbox, send = self._outbox, self._connection.send
        while True:
            await self._filled.wait()
            self._filled.clear()
            while (message := outbox.next()) is not None:
                self._sending_since = self._clock()
                await send(message)
            self._sending_since = math.inf

    async def _watch_writing(self) -> None:
        """Raise TimeoutError when the viewer is stalled; a timer for each message would cost more than it."""
        for _ in iter(lambda: self._clock() - self._sending_since < SEND_S, False):
            await asyncio.sleep(SEND_S / 4)
        raise TimeoutError

    # From the viewer

    async def _read(self) -> None:
        async for message in self._connection:
            self.counts["said"] += 1
            if not self._rate.take(self._clock()):
                raise Overrun(f"more than {RATE_HZ:g} messages a second")
            try:
                self._handle(message)
            except ProtocolError as error:
                self.counts["malformed"] += 1
                self.warn(str(error))
            except Refused as refused:
                self.refuse(refused)
            if self._outbox.overrun:
                raise Overrun("too many queued answers")

    def refuse(self, why: Exception) -> None:
        """Count what was not carried out, and tell the person."""
        self.counts["refused"] += 1
        log.debug("viewer_refused", "{session}: {reason}", session=self.name, reason=why)
        self.warn(str(why))

    def _handle(self, message: str | bytes) -> None:
        if isinstance(message, str):
            text = requests.read_text(message)
            _HANDLERS[type(text)](self, text)
            return
        match requests.read_binary(message):
            case requests.Published(channel_id, payload):
                if (channel := self._published.get(channel_id)) is None:
                    raise Unsupported(f"channel {channel_id} is not one of yours")
                self._source.commands.published(self, channel, payload)
            case ServiceCall() as call:
                if not self._start(self._call(call)):
                    self.say(replies.service_failure(call, f"more than {CALLS} calls at the same time"))
            case requests.PlaybackRequest() as request:
                self._source.play(self, request)

    def _subscribe(self, request: requests.Subscribe) -> None:
        for wanted in request.subscriptions:
            channel_id = wanted.channel_id
            if wanted.id in self._channels or channel_id in self._subscribed:
                self.refuse(Unsupported(f"channel {channel_id} or subscription {wanted.id} is subscribed already"))
            elif len(self._channels) >= SUBSCRIPTIONS:
                self.refuse(Unsupported(f"more than {SUBSCRIPTIONS} subscriptions"))
            elif not self._hub.subscribe(self, wanted.id, channel_id):
                self.refuse(Unsupported(f"there is no channel {channel_id}"))
            else:
                self._channels[wanted.id] = channel_id
                self._subscribed.add(channel_id)

    def _unsubscribe(self, request: requests.Unsubscribe) -> None:
        for subscription in request.subscription_ids:
            channel_id = self._channels.pop(subscription, None)
            if channel_id is not None:
                self._subscribed.discard(channel_id)
                self._hub.unsubscribe(self, channel_id)
                self._outbox.forget(subscription)

    def _advertise(self, request: requests.Advertise) -> None:
        """Take note of any channel: viewers announce some that they never use. What comes on it is judged then."""
        for channel in request.channels:
            if channel.id in self._published or len(self._published) >= PUBLISHED:
                self.refuse(Unsupported(f"channel {channel.id} is there already, or there are {PUBLISHED}"))
            else:
                self._published[channel.id] = channel

    def _unadvertise(self, request: requests.Unadvertise) -> None:
        for channel_id in request.channel_ids:
            if (channel := self._published.pop(channel_id, None)) is not None:
                self._source.commands.unpublished(self, channel)

    def _set(self, request: requests.SetParameters) -> None:
        if not self._start(self._set_parameters(request)):
            raise Unsupported(f"more than {CALLS} calls at the same time")

    def _watch(self, request: requests.SubscribeParameterUpdates) -> None:
        if self._watched is None:
            self._watched = set(request.parameter_names)
            self._source.watch_parameters(True)
        elif self._watched:
            names = self._watched | set(request.parameter_names) if request.parameter_names else set()
            self._watched = names if len(names) <= requests.LISTED else set()

    def _unwatch(self, request: requests.UnsubscribeParameterUpdates) -> None:
        if self._watched is None:
            return
        left = self._watched - set(request.parameter_names) if request.parameter_names else set()
        self._watched = left or None
        if self._watched is None:
            self._source.watch_parameters(False)

    # What takes time

    def _start(self, work: Coroutine[Any, Any, None]) -> bool:
        """Carry out a call; False, and nothing is done, where too many are on their way."""
        if len(self._calls) >= CALLS:
            work.close()
            self.counts["refused"] += 1
            return False
        self._calls.start(work)
        return True

    async def _call(self, call: ServiceCall) -> None:
        try:
            if call.encoding != "json":
                raise Unsupported(f"encoding {call.encoding[:16]!r}: expected 'json'")
            payload = await self._source.commands.call(self, call.service_id, call.payload)
        except (Refused, BusError, ProtocolError) as error:
            self.counts["refused"] += 1
            self.say(replies.service_failure(call, shown(error)))
        else:
            self.say(replies.service_response(call, payload))

    async def _set_parameters(self, request: requests.SetParameters) -> None:
        for parameter in request.parameters:
            try:
                await self._source.commands.set_parameter(self, parameter.name, parameter.value)
            except (Refused, BusError, ProtocolError) as error:
                self.refuse(error)
        if request.id is not None:
            names = tuple(parameter.name for parameter in request.parameters)
            await self._send_parameters(names, request.id, ask=False)

    async def _send_parameters(self, names: tuple[str, ...], request_id: str | None, *, ask: bool = True) -> None:
        self.say(replies.parameter_values(await self._source.parameters(names, ask=ask), request_id))

    async def _leave(self) -> None:
        self._hub.leave(self)
        self.counts["dropped"] += self._outbox.dropped
        if self._watched is not None:
            self._source.watch_parameters(False)
        try:
            await self._source.commands.left(self)
        except Exception as error:  # the others must continue
            log.error("viewer_leave_failed", "{session} left: {error}", session=self.name, error=describe(error))


_HANDLERS: Mapping[type, Callable[[Viewer, Any], object]] = {
    requests.Subscribe: Viewer._subscribe,
    requests.Unsubscribe: Viewer._unsubscribe,
    requests.Advertise: Viewer._advertise,
    requests.Unadvertise: Viewer._unadvertise,
    requests.GetParameters: lambda viewer, get: viewer._start(viewer._send_parameters(get.parameter_names, get.id)),
    requests.SetParameters: Viewer._set,
    requests.SubscribeParameterUpdates: Viewer._watch,
    requests.UnsubscribeParameterUpdates: Viewer._unwatch,
}
