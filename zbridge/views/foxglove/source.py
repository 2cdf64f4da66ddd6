"""What a viewer asks of the server beyond channels; :mod:`live`, :mod:`commands` and :mod:`playback` answer it."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Mapping
from typing import Any

from zbridge import __version__
from zbridge.errors import Unsupported
from zbridge.views.foxglove import replies
from zbridge.views.foxglove.hub import Hub, Subscriber
from zbridge.views.foxglove.replies import Service
from zbridge.views.foxglove.requests import ClientChannel, PlaybackRequest


class ViewerCommands:
    """What viewers tell robots: everything is refused. Methods raise Refused with what to tell people."""

    def services(self) -> list[Service]:
        """Return the services there are."""
        return []

    def published(self, viewer: Subscriber, channel: ClientChannel, payload: bytes) -> None:
        """Take a message of a viewer."""
        raise Unsupported(f"{channel.topic}: nothing can be published here")

    def unpublished(self, viewer: Subscriber, channel: ClientChannel) -> None:
        """Take note that a viewer publishes no more on a channel."""

    async def call(self, viewer: Subscriber, service_id: int, payload: bytes) -> bytes:
        """Carry out a service's call; return its answer in JSON."""
        raise Unsupported("no services here")

    async def set_parameter(self, viewer: Subscriber, name: str, value: Any) -> None:
        """Change a parameter."""
        raise Unsupported(f"{name}: there are no parameters")

    async def left(self, viewer: Subscriber) -> None:
        """Take back what a viewer had: it is gone."""


class ViewerSource:
    """A source that offers channels and refuses everything else. commands: what viewers tell its robots."""

    capabilities: tuple[str, ...] = ()
    times_ns: tuple[int, int] | None = None
    """The first and the last time of a recording."""

    def __init__(self, hub: Hub, commands: ViewerCommands | None = None) -> None:
        self.hub = hub
        self.commands = commands or ViewerCommands()
        self._session_id = secrets.token_hex(8)

    def info(self) -> str:
        """Return the first message to every viewer. The session's id tells a server that was started anew."""
        metadata = {"library": f"zbridge {__version__}"}
        return replies.server_info("zbridge", self.capabilities, self._session_id, metadata, self.times_ns)

    async def run(self) -> None:
        """Work until cancelled; a source that is told of everything by others has nothing to do."""
        await asyncio.Event().wait()

    def greet(self, viewer: Subscriber) -> None:
        """Tell a new viewer what it has to know besides channels and services."""

    async def parameters(self, names: tuple[str, ...], *, ask: bool = True) -> Mapping[str, Any]:
        """Return the values of these parameters, of all if none is named. ask: ask the robots for theirs first."""
        return {}

    def watch_parameters(self, watched: bool) -> None:
        """Take note that some viewer watches parameters, or that none does any more."""

    def play(self, viewer: Subscriber, request: PlaybackRequest) -> None:
        """Play, pause or seek in a recording; raise Refused."""
        raise Unsupported("not a recording")
