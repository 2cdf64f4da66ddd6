"""A robot that is reached by datagrams alone: the peer, refusals, and the socket in other hands."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from collections.abc import Iterator

import pytest

from tests.hq.scene import ToySession, framed
from tests.transport.recorder import Recorder, heard_by, udp_socket, until
from zbridge.errors import LinkError, ProtocolError
from zbridge.host import duplicates
from zbridge.host.duplicates import Duplicates
from zbridge.protocol.address import DatagramAddress
from zbridge.protocol.session import Limits, Session, State
from zbridge.robot.observer import LastStop, StopFrame
from zbridge.transport import Conversation, ConversationHooks, Parcel, attach, connect, datagram_link

pytestmark = pytest.mark.both_loops


@pytest.fixture
def robot() -> Iterator[socket.socket]:
    with contextlib.closing(udp_socket(("127.0.0.1", 0))) as robot:
        yield robot


def at(sock: socket.socket, *, waits: bool = False) -> DatagramAddress:
    return DatagramAddress(*sock.getsockname(), waits=waits)


def session(rate_hz: float = 1000.0) -> ToySession:
    return ToySession(Limits(64, 5.0, rate_hz=rate_hz))


def conversing(session: Session[bytes]) -> tuple[Conversation, list[bytes]]:
    messages: list[bytes] = []
    hooks = ConversationHooks(deliver=messages.extend)
    return Conversation(session, asyncio.get_running_loop(), hooks), messages


async def test_we_speak_first_each_frame_is_a_datagram_and_a_datagram_holds_several(robot: socket.socket) -> None:
    talk, messages = conversing(session())
    link = await connect(at(robot), talk)
    data, gateway = await heard_by(robot)
    assert (data, talk.session.transport) == (framed(b"who are you"), "udp")
    robot.sendto(framed(b"hi") + framed(b"one") + framed(b"two"), gateway)
    await until(lambda: messages == [b"one", b"two"])
    talk.session.send(b"three")
    talk.session.send(b"four")
    talk.pump()
    assert [(await heard_by(robot))[0] for _ in range(2)] == [framed(b"three"), framed(b"four")]
    assert (link.peer, link.ready, link.unacknowledged_s) == (str(at(robot)), True, 0.0)
    talk.abandon()
    await until(lambda: not link.descriptors)


async def test_half_a_frame_ends_with_its_datagram_and_noise_ends_no_session(robot: socket.socket) -> None:
    talk, messages = conversing(session())
    await connect(at(robot), talk)
    _, gateway = await heard_by(robot)
    for data in (framed(b"hi"), framed(b"one") + framed(b"half")[:3], b"lf", b"", b"\xff", framed(b"two")):
        robot.sendto(data, gateway)
    await until(lambda: b"two" in messages)
    assert (messages, talk.session.state) == ([b"one", b"two"], State.ESTABLISHED)
    assert (talk.session.traffic.malformed, talk.session.last_malformed) == (3, "length 255")
    talk.abandon()


async def test_refusals_neither_end_the_link_nor_cost_the_next_datagram(caplog: pytest.LogCaptureFixture) -> None:
    with contextlib.closing(udp_socket(("127.0.0.1", 0))) as gone:
        where = gone.getsockname()
    near = Recorder()
    link = await connect(DatagramAddress(*where), near)
    for _ in range(3):
        link.write(b"refused")
        link.write(b"refused")
        await asyncio.sleep(0.01)
    link.write(b"refused")  # its refusal waits when the robot is there
    with contextlib.closing(udp_socket(where)) as robot:
        link.write(b"heard")
        data, gateway = await heard_by(robot)
        robot.sendto(b"answer", gateway)
        await near.until("received", received=6)
    assert (data, near.data, "lost" in near.calls, caplog.records) == (b"heard", b"answer", False, [])
    link.abort()
    await near.until("lost")


async def test_what_the_kernel_does_not_accept_is_lost_and_counted(robot: socket.socket) -> None:
    talk, _ = conversing(session())
    link = await connect(at(robot), talk)
    link.write(bytes(70_000))
    assert talk.session.traffic.dropped == 1
    link.write(b"small")
    assert [(await heard_by(robot))[0] for _ in range(2)] == [framed(b"who are you"), b"small"]
    talk.abandon()
    link.write(b"late")
    assert talk.session.traffic.dropped == 1


async def test_the_first_that_sends_is_the_peer_and_others_are_foreign(robot: socket.socket) -> None:
    with contextlib.closing(udp_socket(("127.0.0.1", 0))) as free:
        ours = at(free, waits=True)
    near, there = Recorder(), (ours.host, ours.port)
    connecting = asyncio.create_task(connect(ours, near))
    await asyncio.sleep(0.02)
    with contextlib.closing(udp_socket(("127.0.0.1", 0))) as stranger:
        robot.sendto(b"first", there)
        for _ in range(6):
            stranger.sendto(b"other", there)
        robot.sendto(b" and then", there)
        link = await connecting
        await near.until("received", received=14)
        assert (near.data, near.foreign, link.peer) == (b"first and then", 6, str(at(robot)))
        stranger.sendto(b"late", there)
        link.write(b"answer")
        assert await heard_by(robot) == (b"answer", there)
        assert (near.data, near.foreign) == (b"first and then", 6), "the kernel drops it"
    link.close()
    await near.until("lost")
    with contextlib.closing(udp_socket(there)):  # the port is free again
        pass


async def test_a_robot_that_does_not_speak_is_no_link(robot: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(datagram_link, "CONNECT_S", 0.05)
    with contextlib.closing(udp_socket(("127.0.0.1", 0))) as free:
        ours = at(free, waits=True)
    with pytest.raises(LinkError, match=r"udp-in://127.0.0.1:\d+: no datagram within 0.05 s"):
        await connect(ours, Recorder())
    with pytest.raises(LinkError, match="Address already in use"):
        await connect(at(robot, waits=True), Recorder())


async def test_a_paused_link_reads_later_and_a_suspended_one_leaves_it_to_its_successor(robot: socket.socket) -> None:
    near, other = Recorder(), Recorder()
    link = await connect(at(robot), near)
    link.write(b"hello")
    _, gateway = await heard_by(robot)
    link.pause_reading()
    robot.sendto(b"paused", gateway)
    await asyncio.sleep(0.02)
    assert near.data == b""
    link.resume_reading()
    await near.until("received", received=6)
    link.suspend()
    robot.sendto(b"early", gateway)
    await asyncio.sleep(0.02)
    assert (near.data, link.blocker) == (b"paused", None)
    parcel = Parcel()
    state = link.export(parcel)
    link.detach()
    after = await attach(at(robot), state, parcel, other)
    await other.until("received", received=5)
    after.write(b"here")
    assert await heard_by(robot) == (b"here", gateway)
    assert (near.data, other.data, after.peer) == (b"paused", b"early", str(at(robot)))
    assert "lost" not in near.calls
    after.abort()
    with pytest.raises(ProtocolError):
        await attach(at(robot), {}, Parcel(), other)


async def test_who_watches_the_reads_learns_of_those_in_vain(robot: socket.socket) -> None:
    near, seen = Recorder(), []
    link = await connect(at(robot), near)
    link.reads = lambda: seen.append(len(near.data))
    link.write(b"hello")
    _, gateway = await heard_by(robot)
    where = robot.getsockname()
    robot.close()
    link.write(b"refused")
    await near.until("received")
    assert (near.data, seen) == (b"", [0])
    with contextlib.closing(udp_socket(where)) as again:
        again.sendto(b"data", gateway)
        await near.until("received", received=4)
    assert seen == [0, 0]
    link.abort()


async def test_a_supervisor_stops_the_robot_over_the_socket_of_a_dead_process(
    robot: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(duplicates, "PERIOD_S", 0.0)
    near = Recorder()
    link = await connect(at(robot), near)
    with contextlib.closing(Duplicates()) as kept:
        kept.opened(1, "robot", [os.dup(*link.descriptors)], drives=True)
        link.detach()
        stop = LastStop(driven=True, frames=(StopFrame(b"zero"), StopFrame(b"hold")))
        assert await kept.stop(stop, 2) is True
        assert [(await heard_by(robot))[0] for _ in range(4)] == [b"zero", b"hold"] * 2
        where = robot.getsockname()
        robot.close()
        assert await kept.stop(stop, 2) is True, "a refusal is no stall"
        with contextlib.closing(udp_socket(where)) as again:
            assert await kept.stop(stop, 1) is True
            assert [(await heard_by(again))[0] for _ in range(2)] == [b"zero", b"hold"]
