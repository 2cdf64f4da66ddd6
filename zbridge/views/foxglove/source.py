"""What a viewer asks of the server beyond channels; :mod:`live` and :mod:`playback` answer it."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Mapping
from typing import Any, Protocol

from zbridge import __version__
from zbridge.errors import Unsupported
from zbridge.views.foxglove import replies
from zbridge.views.foxglove.hub import Hub
from zbridge.views.foxglove.replies import Service
from zbridge.views.foxglove.requests import ClientChannel, PlaybackRequest


class Person(Protocol):
    """A viewer, as a source needs it.

    name: shown to others as the driver. may_drive: whether its commands may move robots and change them.
    """

    name: str
    may_drive: bool

    def say(self, message: str | bytes) -> None:
        """Send an answer or news."""

    def warn(self, text: str) -> None:
        """Tell the person something."""


class Source:
    """A source that offers channels and refuses everything else. Methods raise Refused with what to tell people."""

    capabilities: tuple[str, ...] = ()
    times_ns: tuple[int, int] | None = None
    """The first and the last time of a recording."""

    def __init__(self, hub: Hub) -> None:
        self.hub = hub
        self._session_id = secrets.token_hex(8)

    def info(self) -> str:
        """Return the first message to every viewer. The session's id tells a server that was started anew."""
        metadata = {"library": f"zbridge {__version__}"}
        return replies.server_info("zbridge", self.capabilities, self._session_id, metadata, self.times_ns)

    async def run(self) -> None:
        """Work until cancelled; a source that is told of everything by others has nothing to do."""
        await asyncio.Event().wait()

    def services(self) -> list[Service]:
        """Return the services there are."""
        return []

    def greet(self, viewer: Person) -> None:
        """Tell a new viewer what it has to know besides channels and services."""

    def published(self, viewer: Person, channel: ClientChannel, payload: bytes) -> None:
        """Take a message of a viewer."""
        raise Unsupported(f"{channel.topic}: nothing can be published here")

    def unpublished(self, viewer: Person, channel: ClientChannel) -> None:
        """Take note that a viewer publishes no more on a channel."""

    async def call(self, viewer: Person, service_id: int, payload: bytes) -> bytes:
        """Carry out a service's call; return its answer in JSON."""
        raise Unsupported("there are no services")

    async def parameters(self, names: tuple[str, ...], *, ask: bool = True) -> Mapping[str, Any]:
        """Return the values of these parameters, of all if none is named. ask: ask the robots for theirs first."""
        return {}

    async def set_parameter(self, viewer: Person, name: str, value: Any) -> None:
        """Change a parameter."""
        raise Unsupported(f"{name}: there are no parameters")

    def watch_parameters(self, watched: bool) -> None:
        """Take note that some viewer watches parameters, or that none does any more."""

    def play(self, viewer: Person, request: PlaybackRequest) -> None:
        """Play, pause or seek in a recording."""
        raise Unsupported("this is no recording")

    async def left(self, viewer: Person) -> None:
        """Take back what a viewer had: it is gone."""
