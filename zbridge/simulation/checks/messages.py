"""Conformance of messages: they round-trip, and any bytes in any cut give messages or ProtocolError."""

from __future__ import annotations

import contextlib
import random
import types
from collections.abc import Callable, Iterator
from typing import Annotated, Any, get_args, get_origin

import msgspec
import numpy as np

from zbridge.errors import EncodeError, ProtocolError, describe
from zbridge.protocol.plugin import Codec, Protocol
from zbridge.simulation.checks.finding import CheckFinding, raised
from zbridge.wire import Counted, Whole
from zbridge.wire.fields import CountedArray, Filling
from zbridge.wire.frames import FrameBuffer, FramingFault

MOST_BYTES = 2**20
RANDOM_CASES = 500
RANDOM_BYTES = 60
DAMAGED_CASES = 60


def check_messages(protocol: Protocol) -> Iterator[CheckFinding]:
    """Check every codec of a protocol."""
    if not protocol.codecs:
        problem = "Protocol.codecs is empty: nothing can be checked"
        yield CheckFinding("messages are declared", problem, guide="8. The protocol")
    for codec in protocol.codecs:
        yield from _check_codec(codec, codec.name)


def _check_codec(codec: Codec, name: str) -> Iterator[CheckFinding]:
    messages, problems = _examples(codec)
    frames = _frames(codec, messages, problems)
    guide = "2. Messages"
    yield CheckFinding.of(f"{name}: {len(codec.messages)} messages round-trip", problems, guide=guide)
    claim = f"{name}: whole, byte by byte and joined give the same"
    yield CheckFinding.of(claim, _cuts(codec, frames), guide=guide)
    cut_off = [frame[:size] for frame in frames for size in range(1, len(frame))]
    claim = f"{name}: what is cut off is a message or a ProtocolError"
    yield CheckFinding.of(claim, _fed(codec, cut_off), guide=guide)
    claim = f"{name}: random bytes are a message or a ProtocolError"
    yield CheckFinding.of(claim, _fed(codec, _noise(frames)), guide=guide)
    yield _damaged(codec, frames)


def example(declared: type) -> Any:
    """Make an example of a message class: fields without a default get a value of their type."""
    values = {}
    for field in msgspec.structs.fields(declared):
        try:
            if field.required:  # the default of another field is its example
                values[field.name] = _value(field.type)
        except (KeyError, TypeError) as error:
            what = f"{declared.__qualname__}.{field.name}: {_name_of(field.type)}"
            raise LookupError(f"{what}: expected one of {', '.join(map(_name_of, _VALUES))}, or a default") from error
    return declared(**values)


def _name_of(hint: Any) -> str:
    return hint.__name__ if isinstance(hint, type) and not get_args(hint) else str(hint)


def _value(hint: Any) -> Any:
    whole = None
    if get_origin(hint) is Annotated:
        hint, *marks = get_args(hint)
        whole = next((mark for mark in marks if isinstance(mark, Whole)), None)
        items = next((mark.dtype for mark in marks if isinstance(mark, CountedArray | Filling)), None)
        if items is not None:
            return np.array([1, 2], items)
        if any(isinstance(mark, Counted) for mark in marks):
            return (example(get_args(hint)[0]),) * 2
    if get_origin(hint) is types.UnionType:
        hint = get_args(hint)[0]
    if hint is int and whole is not None:
        return max(whole.low, min(whole.high, 1))
    return _VALUES[hint]


def _examples(codec: Codec) -> tuple[list[Any], list[str]]:
    messages, problems = [], []
    for declared in codec.messages:
        try:
            messages.append(example(declared) if isinstance(declared, type) else declared)
        except (LookupError, TypeError, ValueError) as error:
            name = getattr(declared, "__qualname__", declared)
            problems.append(f"{name}: the kit can make no example ({error}): list an instance in Codec.messages")
    return messages, problems


def _frames(codec: Codec, messages: list[Any], problems: list[str]) -> list[bytes]:
    """Write and read every example; add what is wrong to ``problems``."""
    frames = []
    for message in messages:
        try:
            frame = codec.write(message)
            again = codec.read(frame)
            frames.append(frame)
            if not _same(message, again):
                problems.append(f"{message} is written as {frame!r}, which is read as {again}")
            elif codec.write(again) != frame:
                problems.append(f"{message} is written as {frame!r}, and once read as {codec.write(again)!r}")
        except Exception as error:  # whatever the protocol's own code raises is a finding
            problems.append(f"{message}: {raised(error, 'a frame, and the same message of it')}")
    return frames


def _same(one: Any, other: Any) -> bool:
    if type(one) is not type(other):
        return False
    if not isinstance(one, msgspec.Struct):
        return bool(one == other)
    pairs = zip(msgspec.structs.astuple(one), msgspec.structs.astuple(other), strict=True)
    return all(np.array_equal(mine, its) if isinstance(mine, np.ndarray) else mine == its for mine, its in pairs)


def _cuts(codec: Codec, frames: list[bytes]) -> list[str]:
    problems: list[str] = []
    for frame in frames:
        for what, parts in (("whole", [frame]), ("byte by byte", [frame[i : i + 1] for i in range(len(frame))])):
            _try(problems, f"{frame!r} {what}", lambda parts=parts: _cut(codec, parts), [frame])  # type: ignore[misc]
    _try(problems, "all messages joined", lambda: _cut(codec, [b"".join(frames)]), frames)
    return problems


def _cut(codec: Codec, parts: list[bytes]) -> list[bytes]:
    buffer = FrameBuffer(codec.frame_end, MOST_BYTES)
    return [frame for part in parts for frame in buffer.feed(part)]


def _try(problems: list[str], what: str, cut: Callable[[], list[bytes]], expected: list[bytes]) -> None:
    try:
        found = cut()
    except Exception as error:
        problems.append(f"{what}: {raised(error, 'frames or ProtocolError')}")
        return
    if found != expected:
        problems.append(f"{what} is cut to {found!r}, expected {expected!r}")


def _noise(frames: list[bytes]) -> list[bytes]:
    """Make noise, and messages of which one byte was changed."""
    rng = random.Random(1)
    noise = [rng.randbytes(rng.randint(1, RANDOM_BYTES)) for _ in range(RANDOM_CASES)]
    return noise + [_changed(frame, rng, 1) for frame in frames for _ in range(20)]


def _changed(frame: bytes, rng: random.Random, places: int) -> bytes:
    data = bytearray(frame)
    for _ in range(places):
        data[rng.randrange(len(data))] = rng.randrange(256)
    return bytes(data)


def _damaged(codec: Codec, frames: list[bytes]) -> CheckFinding:
    """Read messages whose fields were damaged, and whose count and checksum fit again."""
    claim = f"{codec.name}: any fields behind a right checksum are a message or a ProtocolError"
    guide, rng = "8. The protocol", random.Random(2)
    seal = codec.seal or getattr(getattr(codec.frame_end, "__self__", None), "seal", None)
    read, problems = 0, dict[str, str]()
    for frame in [frame for frame in frames for _ in range(DAMAGED_CASES)]:
        damaged = _changed(frame, rng, rng.randint(1, 4))
        if seal is not None and rng.random() < 0.5:  # too long, or too short
            damaged = damaged[: rng.randint(len(frame) // 2, len(frame))] + rng.randbytes(rng.choice((0, 3)))
        try:
            damaged = damaged if seal is None else seal(damaged)
        except EncodeError:  # too long
            continue
        try:
            codec.write(codec.read(damaged))
            read += 1
        except EncodeError:
            read += 1
        except ProtocolError:
            continue
        except Exception as error:  # whatever the protocol's own code raises is a finding
            problems.setdefault(describe(error), f"{damaged!r}: {raised(error, 'a message or ProtocolError')}")
    if problems or read or not frames:
        return CheckFinding.of(claim, list(problems.values()), guide=guide)
    if seal is not None:
        return CheckFinding(claim, "no damaged frame is read: Codec.seal does not make it whole", guide=guide)
    return CheckFinding.not_checked(claim, "no damaged frame is read: give Codec.seal, which computes checksums", guide)


def _fed(codec: Codec, streams: list[bytes]) -> list[str]:
    """Read every stream, and every piece of it as a frame; list what raised anything but ProtocolError."""
    problems: dict[str, str] = {}
    for stream in streams:
        try:
            for frame in FrameBuffer(codec.frame_end, MOST_BYTES).feed(stream):
                with contextlib.suppress(ProtocolError, EncodeError):
                    codec.write(codec.read(frame))
        except FramingFault as fault:
            problems.setdefault(str(fault), f"{stream!r}: {fault}")
        except ProtocolError:
            pass
        except Exception as error:
            problems.setdefault(describe(error), f"{stream!r}: {raised(error, 'a message or ProtocolError')}")
    return list(problems.values())


_VALUES: dict[Any, Any] = {int: 1, float: 0.5, bool: True, str: "ab", bytes: b"ab"}
