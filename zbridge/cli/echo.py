"""``zbridge echo``: prints what is published on a key, or how often."""

from __future__ import annotations

import asyncio
import json
import math
from typing import Any

import msgspec
import numpy as np

from zbridge.bus import Bus, BusSettings, Sample, read_key_expr
from zbridge.cli.terminal import console, errors
from zbridge.client import joined
from zbridge.errors import ConfigError, PayloadError
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.printable import as_json as to_json
from zbridge.fleet.printable import shown
from zbridge.fleet.topics import is_concrete, is_name, split_key
from zbridge.tasks import occurs

HINT_S = 2.0
"""Seconds without a message after which a hint says why."""
EVERY_S = 1.0
"""Seconds between two reports of rates."""
KEYS = 10_000
"""Most keys whose rates are counted."""
_NAMED = 5
"""Most robots that a hint names."""
_SHOWN = 8
"""Bytes of a value that are printed."""
_MESSAGE = 20_000
"""Characters of a message that is printed as text, at most."""
_DEPTH = 32
"""Levels of nested maps and arrays that are printed."""


class Rates:
    """Counts what comes, by key."""

    def __init__(self, now: float) -> None:
        self.left_out = 0
        """Messages on keys beyond :data:`KEYS`."""
        self._keys: dict[str, _KeyRate] = {}
        self._since = now

    def note(self, key: str, now: float) -> None:
        """Count a message."""
        rate = self._keys.get(key)
        if rate is None and len(self._keys) >= KEYS:
            self.left_out += 1
            return
        if rate is None:
            rate = self._keys[key] = _KeyRate(now)
        rate.count += 1
        rate.lately += 1
        rate.pause_s = max(rate.pause_s, now - rate.last)
        rate.last = now

    def report(self, now: float) -> list[dict[str, Any]]:
        """Return a line for each key: all that came, and rate and longest pause since the report before."""
        elapsed, self._since = now - self._since, now
        lines = []
        for key, rate in sorted(self._keys.items()):
            pause_s = max(rate.pause_s, now - rate.last)
            hz = rate.lately / elapsed if elapsed > 0 else 0.0
            lines.append({"key": key, "count": rate.count, "hz": round(hz, 3), "longest_pause_s": round(pause_s, 4)})
            rate.lately, rate.pause_s = 0, 0.0
        return lines


class _KeyRate(msgspec.Struct):
    last: float
    count: int = 0
    lately: int = 0
    pause_s: float = 0.0


class Echo(msgspec.Struct, frozen=True, kw_only=True):
    """What ``zbridge echo`` prints, and until when. count, seconds: end after this many, 0 = never.

    hz: rates once a second instead of messages.
    """

    key: str
    as_json: bool = False
    count: int = 0
    seconds: float = 0.0
    hz: bool = False


async def echo(settings: BusSettings, options: Echo, *, realm: str | None = None) -> bool:
    """Print the messages on a key, the last value of each state first; or how often they come.

    realm: None takes that of the key. Return False if the time passed with fewer messages than ``count``, or with none.
    Raise ConfigError for an invalid key expression, or one of another realm.
    """
    key, loop = read_key_expr("KEY", options.key), asyncio.get_running_loop()
    seen, came, done = 0, asyncio.Event(), asyncio.Event()
    realm = _realm_of(key, realm)

    def take(sample: Sample) -> None:
        nonlocal seen
        if options.count and seen >= options.count:
            return
        seen += 1
        came.set()
        if options.hz:
            rates.note(sample.key, loop.time())
        else:
            console.print(_line(sample, as_json=options.as_json))
        if seen == options.count:
            done.set()

    async with joined(settings, realm) as bus:
        rates = Rates(loop.time())
        bus.subscribe(key, take, history=not options.hz)
        hints = asyncio.ensure_future(_hint(bus, key, came))
        try:
            await _until_done(rates, done, options)
        finally:
            hints.cancel()
            await asyncio.gather(hints, return_exceptions=True)
    if seen and seen >= options.count:
        return True
    errors.print(shown(f"{seen or 'no'} messages on {key} within {options.seconds:g} s"))
    return False


async def _until_done(rates: Rates, done: asyncio.Event, options: Echo) -> None:
    """Wait until all messages came, or the time has passed; print rates meanwhile, if they are wanted."""
    if not options.hz:
        await occurs(done, options.seconds or None)
        return
    loop = asyncio.get_running_loop()
    ends_at = loop.time() + options.seconds if options.seconds else math.inf
    while (left_s := ends_at - loop.time()) > 0:
        ended = await occurs(done, min(EVERY_S, left_s))
        for fields in rates.report(loop.time()):
            console.print(to_json(fields) if options.as_json else _rate_line(fields))
        if rates.left_out:
            errors.print(f"{rates.left_out} messages on further keys than {KEYS}")
        if ended:
            return


def _rate_line(fields: dict[str, Any]) -> str:
    rate, pause = f"{fields['hz']:.1f} Hz", f"longest pause {fields['longest_pause_s']:.3f} s"
    return shown(f"{fields['key']}  {rate}, {fields['count']} messages, {pause}", _MESSAGE)


async def _hint(bus: Bus, key: str, came: asyncio.Event) -> None:
    """Say on stderr why nothing comes, unless something does within :data:`HINT_S`."""
    if await occurs(came, HINT_S):
        return
    tokens = await bus.alive(topics.gateways_of(key))
    robots = sorted({split[1] for token in tokens if (split := split_key(token)) is not None})
    if came.is_set():
        return
    if not robots:
        _, name, *_ = (*key.split("/"), "**")
        whom = f"robot {name}" if is_name(name) else "robots"
        errors.print(shown(f"nothing yet on {key}: no {whom} on the bus: `zbridge ls` lists those that are"))
    elif not on_demand(key):
        named = ", ".join(robots[:_NAMED]) + (f" and {len(robots) - _NAMED} more" if len(robots) > _NAMED else "")
        what = "is on the bus, but publishes" if len(robots) == 1 else "are on the bus, but publish"
        errors.print(shown(f"nothing yet on {key}: {named} {what} nothing there: `zbridge ls` shows states"))


def on_demand(key: str) -> bool:
    """Return whether robots publish on a key only when somebody asks, commands or watches: silence means nothing."""
    *_, last = key.split("/")
    return last == topics.IMAGE.path or any(chunk.startswith("@") for chunk in key.split("/"))


def _realm_of(key: str, realm: str | None) -> str | None:
    """Return the realm of a key expression, None if it has several; raise ConfigError if it is not ``realm``."""
    first = key.partition("/")[0]
    if realm is None:
        return first if is_name(first) else None
    if not is_name(realm):
        raise ConfigError(f"realm = {realm!r}: expected letters, digits, '_', '.' and '-' only")
    if is_concrete(first) and first != realm:
        raise ConfigError(f"KEY = {key!r}: expected a key of realm {realm}, as {realm + '/' + key!r}")
    return realm


def _line(sample: Sample, *, as_json: bool) -> str:
    try:
        fields = _fields(sample)
    except PayloadError as error:
        fields = {"error": str(error)}
    if as_json:
        return to_json({"key": sample.key} | _plain(fields) | {"key": sample.key})
    line = f"{sample.key} " + " ".join(f"{name}={_short(value)}" for name, value in fields.items())
    return shown(line, _MESSAGE)


def _fields(sample: Sample) -> dict[str, Any]:
    split = split_key(sample.key)
    topic = topics.find(split[2]) if split else None
    if topic is None:
        return payloads.unpack(sample.payload)
    message: FleetMessage = payloads.decode(topic.message, sample.payload)
    fields = msgspec.structs.asdict(message)
    return {name: value for name, value in fields.items() if value is not None and value is not msgspec.UNSET}


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{list(value.shape)}"
    if isinstance(value, bytes):
        return f"{value[:_SHOWN].hex(' ')}{'...' if len(value) > _SHOWN else ''} ({len(value)} bytes)"
    if isinstance(value, float):
        return f"{value:.4g}"
    return json.dumps(_plain(value), ensure_ascii=False)


def _plain(value: Any, depth: int = _DEPTH) -> Any:
    """Return a value that JSON can hold: arrays as lists, bytes as hex, NaN and infinity as null, the rest as text."""
    if isinstance(value, msgspec.Struct):
        value = msgspec.structs.asdict(value)
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, dict | list | tuple) and not depth:
        return "..."
    if isinstance(value, dict):
        return {str(name): _plain(item, depth - 1) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item, depth - 1) for item in value]
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, str | int) else str(value)
