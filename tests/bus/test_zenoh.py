"""The bus over Zenoh itself: sessions inside this process, on loopback, without waiting for any length of time."""

from __future__ import annotations

import asyncio
import gc
import math
import threading
import weakref
from collections.abc import AsyncIterator
from typing import Any

import msgpack
import pytest
import zenoh

from tests.bus import SOON_S, Seen
from tests.ports import free_port
from zbridge.bus import BusSettings, PriorityClass, ReadPayload, open_bus
from zbridge.bus.zenoh import ZenohBus, declared, incoming, publishers, session, zenoh_config
from zbridge.errors import BusError, Code, Held, Refused, Unsupported
from zbridge.fleet import topics
from zbridge.metrics import Metrics

BLOCK = zenoh.CongestionControl.BLOCK
ALONE = BusSettings(multicast=False, listen=("tcp/127.0.0.1:0",))


@pytest.fixture
async def bus() -> AsyncIterator[ZenohBus]:
    opened = await open_bus(ALONE, Metrics())
    yield opened
    await opened.close()


async def test_the_priority_of_a_sample_is_chosen_by_its_attachment_and_what_a_sort_drops_never_comes(bus) -> None:
    seen, sorted_out = Seen(), list[tuple[str, bytes | None, int, bytes]]()
    all_sorted = threading.Event()

    def priority(key: str, attachment: bytes | None, size: int, read_payload: ReadPayload) -> PriorityClass | None:
        sorted_out.append((key, attachment, size, read_payload()))
        if len(sorted_out) == len(sent):
            all_sorted.set()
        return (
            None if attachment == b"bad" else PriorityClass.COMMAND if attachment == b"holder" else PriorityClass.OTHER
        )

    bus.subscribe("fleet/r1/@cmd/**", lambda sample: seen.take(sample.payload, sample.attachment), priority=priority)
    drive = bus.publisher("fleet/r1/@cmd/drive", topics.CMD_DRIVE)
    sent = [(b"1", None), (b"2", b"other"), (b"3", b"holder"), (b"4", b"bad"), (b"5", b"holder"), (b"6", b"last")]
    for payload, attachment in sent:
        drive.put(payload, attachment)
    assert all_sorted.wait(SOON_S)  # the event loop stands still meanwhile, so that everything waits for it
    assert sorted_out == [("fleet/r1/@cmd/drive", shown, 1 + len(shown or b""), payload) for payload, shown in sent]
    await seen.until(lambda: len(seen) == 5)
    assert seen == [sent[2], sent[4], sent[0], sent[1], sent[5]]


async def test_the_priority_of_a_question_is_chosen_by_its_payload_and_what_a_sort_drops_is_not_answered(bus) -> None:
    chosen = list[tuple[str, bytes | None, int, bytes]]()

    def priority(key: str, payload: bytes | None, size: int, read_payload: ReadPayload) -> PriorityClass | None:
        chosen.append((key, payload, size, read_payload()))
        return PriorityClass.COMMAND if payload == b"proof" else None

    bus.answer("fleet/r1/@rpc/control/renew", lambda question: question.answer(b"yes"), priority=priority)
    for key in ("fleet/r1/@rpc/control/renew", "fleet/*/@rpc/control/renew"):
        assert len(await bus.ask(key, b"proof")) == 1
        assert chosen[-1] == (key, b"proof", 5, b"")
    assert await bus.ask("fleet/r1/@rpc/control/renew", b"forged", timeout_s=SOON_S) == []


async def test_an_error_reply_is_a_map_of_code_and_reason(bus: ZenohBus) -> None:
    bus.answer("fleet/r1/@rpc/map", lambda question: question.refuse(Unsupported("the robot has no map")))
    replies = await asyncio.to_thread(lambda: list(bus._session.get("fleet/r1/@rpc/map", timeout=SOON_S)))
    (error,) = (reply.err for reply in replies)
    assert error is not None
    assert msgpack.unpackb(error.payload.to_bytes()) == {"code": "unsupported", "reason": "the robot has no map"}
    assert str(error.encoding) == "application/msgpack;zbridge.Denied.v1"
    (reply,) = await bus.ask("fleet/r1/@rpc/map")
    assert isinstance(reply.error, Unsupported)
    assert str(reply.error) == "the robot has no map"


@pytest.mark.parametrize(
    ("payload", "kind", "text"),
    [
        (b"Timeout", BusError, "Timeout"),
        (b"\xff\xfe", BusError, "\ufffd\ufffd"),
        (b"", BusError, ""),
        (msgpack.packb({"reason": "no code"}), BusError, None),
        (msgpack.packb({"code": "held", "reason": "held by ann"}), Held, "held by ann"),
        (msgpack.packb({"code": "of tomorrow", "reason": "why not"}), Unsupported, "why not"),
    ],
)
def test_an_error_reply_of_anybody_is_read(payload: bytes, kind: type[Exception], text: str | None) -> None:
    error = incoming.read_error(payload)
    assert type(error) is kind
    assert text is None or str(error) == text
    assert not isinstance(error, Refused) or error.code in Code


async def test_flush_waits_for_what_was_given_to_be_published_but_not_for_ever(bus, monkeypatch) -> None:
    seen, go = Seen(), threading.Event()
    bus.subscribe("fleet/r1/@cmd/mode", lambda sample: seen.take(sample.payload))
    bus._writer.put(lambda: go.wait(SOON_S))  # as a full transmission queue holds it
    bus.publisher("fleet/r1/@cmd/mode", topics.CMD_MODE).put(b"mode")
    with monkeypatch.context() as patch:
        patch.setattr(session, "FLUSH_S", 0.01)
        with pytest.raises(BusError, match=r"the bus accepted nothing for 0\.01 s"):
            await bus.flush()
    flushed = asyncio.ensure_future(bus.flush())
    await asyncio.to_thread(lambda: None)
    assert not flushed.done()
    go.set()
    async with asyncio.timeout(SOON_S):
        await flushed
    await seen.until(lambda: seen == [b"mode"])


class Busy:
    """An entity of Zenoh's whose callback runs for a while: so long taking it back fails as the library does."""

    def __init__(self, times: float, why: str = "Already borrowed") -> None:
        self.asked: list[str] = []
        self.undeclared = threading.Event()
        self._times = times
        self._why = why

    def undeclare(self) -> None:
        self.asked.append(threading.current_thread().name)
        if len(self.asked) <= self._times:
            raise RuntimeError(self._why)
        self.undeclared.set()


def test_what_meets_its_own_callback_is_taken_back_again_and_a_callback_that_goes_on_keeps_nobody_waiting() -> None:
    here = threading.current_thread().name
    entity = Busy(2)
    handle = declared.Declared(entity)
    handle.close()
    assert entity.undeclared.is_set()
    handle.close()
    assert entity.asked == 3 * [here], "taken back once"
    entity = Busy(30)
    declared.Declared(entity).close()
    assert 0 < entity.asked.count(here) < 10
    assert entity.undeclared.wait(SOON_S)
    assert len(entity.asked) == 31


def test_a_callback_that_never_ends_is_given_up_and_said_so_and_other_errors_are_raised(caplog, monkeypatch) -> None:
    monkeypatch.setattr(declared, "UNDECLARE_S", 0.05)
    declared.Declared(Busy(math.inf)).close()
    for thread in threading.enumerate():
        if thread.name == "zbridge-undeclare":
            thread.join(SOON_S)
    assert "could not be undeclared: Already borrowed" in caplog.text
    with pytest.raises(RuntimeError, match="no such thing"):
        declared.Declared(Busy(math.inf, "no such thing")).close()


async def test_subscribers_queryables_and_publishers_of_every_kind_are_taken_back_again(bus: ZenohBus) -> None:
    handles = [
        bus.subscribe("k/*", lambda sample: None),
        bus.answer("k/q", lambda question: None),
        bus.announce("k/@alive/x"),
        bus.publisher("k/stream", topics.POSE),
        bus.publisher("k/state", topics.STATUS),
        bus.publisher("k/command", topics.CMD_MODE),
        bus.frames("k/@wire", lambda anybody: None),
    ]
    for handle in handles:
        assert isinstance(handle, declared.Declared)
        handle.close()
        assert handle.closed


async def test_streams_above_the_first_ones_are_published_all_the_same_and_leave_nothing_behind(
    bus: ZenohBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publishers, "STREAM_PUBLISHERS", 2)
    seen = Seen()
    bus.subscribe("fleet/r1/sensor/*", lambda sample: seen.take(sample.key, sample.payload))
    names = [f"s{number}" for number in range(5)]
    streams = [bus.publisher(f"fleet/r1/sensor/{name}", topics.SENSOR(name)) for name in names]
    kinds = [type(publisher).__name__ for publisher in streams]
    assert kinds == 2 * ["_StreamPublisher"] + 3 * ["_StreamKey"]
    bus.put_all([(publisher, [b"1", b"2"]) for publisher in streams])
    streams[-1].put(b"3")
    await seen.until(lambda: len(seen) == 11)
    expected = {(f"fleet/r1/sensor/{name}", payload) for name in names for payload in (b"1", b"2")}
    assert set(seen) == expected | {("fleet/r1/sensor/s4", b"3")}
    for publisher in streams:
        publisher.close()
        publisher.close()
        assert publisher.closed  # type: ignore[attr-defined]
    again = bus.publisher("fleet/r1/sensor/s0", topics.SENSOR("s0"))
    assert type(again).__name__ == "_StreamPublisher", "one that had a publisher is given one again"


async def test_what_waits_to_be_written_without_loss_is_written_before_its_key_is_given_up() -> None:
    bus = await open_bus(BusSettings(multicast=False, listen=("tcp/127.0.0.1:0",), stream="block"), Metrics())
    try:
        seen, go = Seen(), threading.Event()
        bus.subscribe("fleet/r1/sensor/*", lambda sample: seen.take(sample.payload))
        publisher = bus.publisher("fleet/r1/sensor/s", topics.SENSOR("s"))
        bus._streams.put(lambda: go.wait(SOON_S))
        bus.put_all([(publisher, [b"1", b"2"])])
        publisher.close()
        go.set()
        await seen.until(lambda: seen == [b"1", b"2"])
    finally:
        await bus.close()


async def test_what_was_closed_is_forgotten(bus: ZenohBus, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(publishers, "STREAM_PUBLISHERS", 2)
    kept: list[weakref.ref[Any]] = []

    def open_and_close(key: str, topic: topics.Topic) -> None:
        publisher = bus.publisher(f"fleet/r1/{key}", topic)
        publisher.close()
        kept.append(weakref.ref(publisher))

    for number in range(1000):
        open_and_close(f"sensor/s{number}", topics.SENSOR(f"s{number}"))
        open_and_close(f"state{number}", topics.STATUS)
    gc.collect()
    assert sum(each() is not None for each in kept) < 200


async def test_questions_beyond_the_rate_are_not_answered_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(incoming, "QUERIES_HZ", 2.0)
    metrics = Metrics()
    bus = await open_bus(ALONE, metrics)
    bus.answer("fleet/r1/@rpc/pose", lambda question: question.answer(b"yes"))
    answers = await asyncio.gather(*(bus.ask("fleet/r1/@rpc/pose", timeout_s=SOON_S) for _ in range(50)))
    assert 2 <= sum(map(len, answers)) < 50
    assert metrics.total("bus_queries_unanswered") == 50 - sum(map(len, answers))
    await bus.close()


BOUNDS = {
    **dict.fromkeys(("r1/@cmd/drive", "r1/@cmd/motor/left", "*/@cmd/mode", "**/@cmd/stop"), 256),
    "r1/@cmd/sensor/front": 16_384,
    **dict.fromkeys(("r1/@cmd/scan", "r1/@cmd/raw/tcpudp", "r1/@cmd/*", "r1/@cmd/none"), 65_536),
}


REPORT = "fleet/r1/@rpc/control/refused/hq.desk"


async def test_what_is_too_large_for_its_key_is_dropped_before_anybody_is_called() -> None:
    where = (f"tcp/127.0.0.1:{free_port()}",)
    gateway = await open_bus(BusSettings(multicast=False, listen=where), Metrics(), bounds=topics.size_bounds())
    sender = await asyncio.to_thread(zenoh.open, zenoh_config(BusSettings(multicast=False, connect=where)))
    seen, called = Seen(), list[tuple[str, int]]()

    def sort(key: str, shown: bytes | None, size: int, read_payload: ReadPayload) -> PriorityClass | None:
        called.append((key, size))
        return PriorityClass.OTHER

    gateway.subscribe("fleet/r1/@cmd/**", lambda sample: seen.take(sample.key, len(sample.payload)), priority=sort)
    gateway.answer("fleet/r1/@rpc/pose", lambda question: question.answer(b"yes"))
    gateway.answer(REPORT, lambda question: question.answer(b"yes"))

    def put_all() -> None:
        while not list(sender.get("fleet/r1/@rpc/pose", timeout=0.1)):
            pass
        for key, most in BOUNDS.items():
            for payload, attachment in ((most + 1, 0), (most - 9, 10), (most - 10, 10), (0, most + 1), (1, 0)):
                sender.put(f"fleet/{key}", bytes(payload), attachment=bytes(attachment), congestion_control=BLOCK)
        assert list(sender.get("fleet/r1/@rpc/pose", payload=bytes(1025), timeout=SOON_S)) == []
        reports = [list(sender.get(REPORT, payload=bytes(size), timeout=SOON_S)) for size in (16_384, 16_385)]
        assert list(map(len, reports)) == [1, 0]

    try:
        await asyncio.to_thread(put_all)
        await seen.until(lambda: len(seen) == 2 * len(BOUNDS))
        assert seen == [(f"fleet/{key}", size) for key, most in BOUNDS.items() for size in (most - 10, 1)]
        assert called == [(f"fleet/{key}", size) for key, most in BOUNDS.items() for size in (most, 1)]
    finally:
        await asyncio.to_thread(sender.close)
        await gateway.close()


async def test_keys_that_are_gathered_share_a_queryable_and_are_answered_each_by_its_own(bus: ZenohBus) -> None:
    gathered = bus.gather("fleet/r1/@rpc/**")
    for name in ("map", "control/acquire/*", "control/renew"):
        bus.answer(f"fleet/r1/@rpc/{name}", lambda question, name=name: question.answer(name.encode()))  # type: ignore[misc]
    other = bus.answer("fleet/r2/@rpc/map", lambda question: question.answer(b"of r2"))
    for asked, answers in {
        "map": {"map": b"map"},
        "control/acquire/ann": {"control/acquire/ann": b"control/acquire/*"},
        "control/acquire/a/b": {},
        "control/acquire/*": {"control/acquire/*": b"control/acquire/*"},
        "control/*": {"control/renew": b"control/renew"},
        "pose": {},
        "**": {name: name.encode() for name in ("map", "control/renew")} | {"**": b"control/acquire/*"},
    }.items():
        replies = await bus.ask(f"fleet/r1/@rpc/{asked}", timeout_s=SOON_S)  # returns with the last reply
        assert {reply.key.removeprefix("fleet/r1/@rpc/"): reply.payload for reply in replies} == answers, asked
    assert {reply.payload for reply in await bus.ask("fleet/*/@rpc/map")} == {b"map", b"of r2"}
    other.close()
    gathered.close()


async def test_a_gathered_key_that_is_closed_is_answered_no_more(bus) -> None:
    bus.gather("fleet/r1/@rpc/**")
    handles = [bus.answer(f"fleet/r1/@rpc/{name}", lambda question: question.answer(b"")) for name in ("map", "pose")]
    handles[0].close()
    assert await bus.ask("fleet/r1/@rpc/map") == []
    assert len(await bus.ask("fleet/r1/@rpc/pose")) == 1
    handles[1].close()
    assert await bus.ask("fleet/r1/@rpc/pose") == []


async def test_buses_that_share_a_session_close_alone_and_serve_each_others_commands(bus: ZenohBus) -> None:
    seen, metrics = Seen(), Metrics()
    shares = [bus.share(metrics.labelled(robot=name)) for name in ("r1", "r2")]
    for name, share in zip(("r1", "r2"), shares, strict=True):
        share.subscribe(
            f"fleet/{name}/@cmd/**", lambda sample: seen.take(sample.key), priority=lambda *_: PriorityClass.COMMAND
        )
    assert {share.zid for share in shares} == {bus.zid}
    bus.publisher("fleet/r2/@cmd/drive", topics.CMD_DRIVE).put(b"1")
    await seen.until(lambda: len(seen) == 1)
    waiting = shares[1]._inbox.source(lambda item: seen.take(item))
    waiting.put("urgent", PriorityClass.COMMAND)
    shares[0].attend()  # in the middle of long work for r1
    assert seen[-1] == "urgent"
    assert await shares[0].close()
    shares[0].attend()
    bus.publisher("fleet/r2/@cmd/stop", topics.CMD_STOP).put(b"2")
    await seen.until(lambda: len(seen) == 3)
