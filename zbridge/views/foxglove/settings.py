"""The options of ``zbridge foxglove``, checked as a whole before anything starts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec

from zbridge.errors import ConfigError, LinkError
from zbridge.fleet.topics import is_name
from zbridge.protocol.address import Address
from zbridge.protocol.networks import is_loopback, parse_network
from zbridge.views.foxglove.admission import FOXGLOVE_ORIGINS, Policy
from zbridge.views.foxglove.requests import Scale

TOKEN_CHARACTERS = 16
"""The shortest token."""


class FoxgloveOptions(msgspec.Struct, frozen=True):
    """The options as they are given; the command's help says what each is."""

    listen: str = "127.0.0.1:8765"
    robots: Sequence[str] = ()
    drive: bool = False
    token: Path | None = None
    origins: Sequence[str] = ()
    allow: Sequence[str] = ()
    tls_certificate: Path | None = None
    tls_key: Path | None = None
    insecure: bool = False
    speed_full_mps: Sequence[str] = ()
    turn_full_radps: Sequence[str] = ()
    who: str = "foxglove"
    viewers: int = 32
    metrics: str = ""


class FoxglovePlan(msgspec.Struct, frozen=True):
    """What the server starts from. scales: by robot, of others by ``""``. tls: certificate and key."""

    address: Address
    policy: Policy
    scales: Mapping[str, Scale]
    robots: frozenset[str]
    tls: tuple[str, str] | None
    metrics: Address | None = None


def plan(options: FoxgloveOptions) -> FoxglovePlan:
    """Check the options; raise ConfigError, which names the option."""
    address = _address("--listen", options.listen)
    if (options.tls_certificate is None) != (options.tls_key is None):
        raise ConfigError("--tls-certificate and --tls-key: expected both")
    tls = (str(options.tls_certificate), str(options.tls_key)) if options.tls_certificate is not None else None
    token = _token(options.token) if options.token is not None else None
    near = is_loopback(address.host)
    if not near and tls is None and not options.insecure:
        raise ConfigError(
            f"--listen {options.listen}: other machines need --tls-certificate and --tls-key, or --insecure"
        )
    if not near and options.drive and token is None:
        raise ConfigError(f"--drive at {options.listen}: expected --token, for programs elsewhere can send any Origin")
    for name in (*options.robots, options.who):
        if not is_name(name):
            raise ConfigError(f"{name!r}: expected letters, digits, '_', '.' and '-' only")
    policy = Policy(
        origins=(*FOXGLOVE_ORIGINS, *map(_origin, options.origins)),
        networks=tuple(parse_network(f"--allow {text}", text) for text in options.allow),
        token=token,
        drive=options.drive,
        viewers=options.viewers,
        who=options.who,
    )
    metrics = _address("--metrics", options.metrics) if options.metrics else None
    return FoxglovePlan(address, policy, _scales(options), frozenset(options.robots), tls, metrics)


def _address(option: str, text: str) -> Address:
    try:
        return Address.parse(text if "://" in text else f"tcp://{text}")
    except LinkError as error:
        raise ConfigError(f"{option} {text}: expected host:port: {error}") from error


def _token(path: Path) -> str:
    try:
        token = path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--token {path}: {getattr(error, 'strerror', None) or error}") from error
    if len(token) < TOKEN_CHARACTERS or not token.isascii() or not token.isalnum():
        raise ConfigError(f"--token {path}: expected a line of at least {TOKEN_CHARACTERS} letters and digits")
    return token


def _origin(text: str) -> str:
    if "://" not in text or text.endswith("/") or text == "*":
        raise ConfigError(f"--origin {text}: expected an Origin like 'https://example.org'")
    return text


def _scales(options: FoxgloveOptions) -> dict[str, Scale]:
    speeds = _by_robot("--speed-full-mps", options.speed_full_mps)
    turns = _by_robot("--turn-full-radps", options.turn_full_radps)
    robots = speeds.keys() | turns.keys()
    return {robot: Scale(speeds.get(robot, speeds[""]), turns.get(robot, turns[""])) for robot in robots}


def _by_robot(option: str, texts: Sequence[str]) -> dict[str, float]:
    """Read ``0.5`` (all robots, by the name ``""``) and ``r1=0.5``."""
    values = {"": 1.0}
    for text in texts:
        robot, _, number = text.rpartition("=")
        try:
            value = float(number)
        except ValueError:
            value = math.nan
        if not 0 < value < math.inf or (robot and not is_name(robot)):
            raise ConfigError(f"{option} {text}: expected a number above 0, or ROBOT=NUMBER")
        values[robot] = value
    return values
