"""The settings of a robot's camera (``[camera]``), and the plan made of them."""

from __future__ import annotations

import re
from typing import Annotated
from urllib.parse import urlsplit

import msgspec

from zbridge.errors import ConfigError, LinkError
from zbridge.protocol.address import Address
from zbridge.protocol.networks import Network, parse_networks

_EXPECTED = "expected http://host:port/path"
_TARGET = re.compile(r"[!-~]+")


class CameraSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[camera]``: where the robot streams MJPEG, and who receives it.

    rate_hz: most images a second on the bus. stall_s: a stream without a picture for this long is ended. relay:
    host:port at which HQ programs find ``/stream.mjpg``; None: nowhere. clients: of the relay, most at a time. allow:
    networks that they may connect from; empty: all.
    """

    url: str
    rate_hz: Annotated[float, msgspec.Meta(ge=0.1, le=240)] = 30.0
    stall_s: Annotated[float, msgspec.Meta(ge=0.5, le=3600)] = 5.0
    relay: str | None = None
    clients: Annotated[int, msgspec.Meta(ge=1, le=64)] = 16
    allow: tuple[str, ...] = ()


class CameraSource(msgspec.Struct, frozen=True):
    """Where a camera streams. target: path and query, as the request names them."""

    host: str
    port: int
    target: str

    def __str__(self) -> str:
        return f"http://{self.authority}{self.target.partition('?')[0]}"  # a query may hold a password

    @property
    def authority(self) -> str:
        """Host and port, as a URL and the header ``Host`` write them."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{host}:{self.port}"


class CameraPlan(msgspec.Struct, frozen=True):
    """What a camera is made of. relay: where its relay listens; None: nowhere."""

    source: CameraSource
    settings: CameraSettings
    relay: Address | None = None
    allow: tuple[Network, ...] = ()


def plan_camera(settings: CameraSettings) -> CameraPlan:
    """Check ``[camera]``; raise ConfigError that names key, value and what was expected."""
    if settings.relay is None and settings.allow:
        raise ConfigError(f"camera.allow = {list(settings.allow)}: expected only with camera.relay")
    allow = parse_networks("camera.allow", settings.allow)
    try:
        relay = Address.parse(f"tcp://{settings.relay}") if settings.relay is not None else None
    except LinkError as error:
        raise ConfigError(f"camera.relay = {settings.relay!r}: expected host:port") from error
    return CameraPlan(_source(settings.url), settings, relay, allow)


def _source(url: str) -> CameraSource:
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
        (host or "").encode("idna")
    except ValueError as error:
        raise ConfigError(f"camera.url = {url!r}: {error}; {_EXPECTED}") from error
    target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
    odd = parts.fragment or parts.username is not None or not _TARGET.fullmatch(url)
    if parts.scheme != "http" or not host or port == 0 or odd:
        raise ConfigError(f"camera.url = {url!r}: {_EXPECTED}")
    return CameraSource(host, port or 80, target)
