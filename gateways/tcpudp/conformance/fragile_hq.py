"""A simulated HQ program as fragile as the deployed ones: the judge of a gateway that plays robot.

It records each violation of what the protocol page ``tcpudp.md`` demands towards HQ programs, and dies of what cripples
them. It shares no code with the gateway: not its messages, session, settings or translation. Section names in the
docstrings are those of that page.
"""

from __future__ import annotations

import asyncio
import contextlib
import enum
import errno
import socket
import struct
import time
from collections import Counter
from collections.abc import Callable, Coroutine, Sequence
from typing import Literal

from gateways.tcpudp.conformance import parser as wire
from gateways.tcpudp.conformance.parser import Feature, HqTimes, Packet
from zbridge.simulation.judge import Ended, Judge, show
from zbridge.simulation.sockets import connected
from zbridge.simulation.stream_reader import STAMPED, Read, StreamReader

Channel = Literal["tcp", "udp"]

_DATAGRAM_BYTES = 65536
_SMALLEST_READ = 6
_WAITING = 1000
DEPLOYED_PORT = 11000
"""The UDP port that deployed programs bind ("Handshake", Ports)."""


class _Phase(enum.Enum):
    CONNECTED = enum.auto()
    GREETED = enum.auto()
    ANSWERED = enum.auto()
    PROBING = enum.auto()
    ESTABLISHED = enum.auto()
    ENDED = enum.auto()


_DEPLOYED = HqTimes()


class FragileHq(Judge):
    """An HQ program of one version, for one connection: records every violation and dies of the deadly ones.

    ``lidar_sim``: announce LidarSim; ``skips_map_flag``: read the map's size where the SLAMMap flag is;
    ``unasked``: a 1.1 program has handlers for 53 and 55 before it asked, unlike the first programs of 1.1;
    ``repeat_s``: seconds between repetitions of the stick, None for a viewer that sends nothing by itself;
    ``udp_port``: the port to bind, 0 for any; None: the deployed one, or any if that is taken; ``keep``: most
    entries of every list; ``note``: called with each violation.
    """

    def __init__(
        self,
        *,
        version: str = "1.3",
        udp: bool = True,
        lidar_sim: bool = False,
        skips_map_flag: bool = False,
        unasked: bool = False,
        repeat_s: float | None = 0.5,
        udp_port: int | None = None,
        keep: int = 10_000,
        note: Callable[[str], None] | None = None,
        times: HqTimes = _DEPLOYED,
    ) -> None:
        if version not in wire.HQ_SENT or (lidar_sim and wire.FLAGS[version] <= Feature.LIDAR_SIM):
            raise ValueError(f"no HQ of version {version}" + " announces LidarSim" * lidar_sim)
        super().__init__(keep=keep, note=note)
        self.version = version
        self.received: list[tuple[float, Channel, int, bytes]] = []
        self.established = asyncio.Event()
        self.settings: wire.Announced | None = None
        self.position: tuple[float, float, float] | None = None
        self.map: bytes | None = None
        self.lidar_on: bool | None = None
        self.texts: list[str] = []
        self.counts: Counter[int] = Counter()
        self._offers_udp, self._lidar_sim, self._skips = udp, lidar_sim, skips_map_flag
        self._unasked = unasked or version != "1.1"
        self._asked: set[int] = set()
        self._repeat_s, self._udp_port, self._times = repeat_s, udp_port, times
        self._phase = _Phase.CONNECTED
        self._reads = wire.Reads(wire.HQ_LOSES_BYTES - 1)
        self._stick = (wire.STOP, b"")
        self._inbox: asyncio.Queue[tuple[Channel, Read]] = asyncio.Queue(_WAITING)
        self._tasks: asyncio.TaskGroup | None = None
        self._tcp: socket.socket | None = None
        self._robot: tuple[str, int] = ("", 0)
        self._udp: socket.socket | None = None
        self._answered = False
        self._works: bool | None = None

    def __repr__(self) -> str:
        return f"<FragileHq {self.version} {self._phase.name} violations={len(self.violations)} alive={self.alive}>"

    @property
    def client_id(self) -> int:
        """The id the robot gave, 0 before that."""
        return self.settings.client if self.settings else 0

    async def run(self, host: str, port: int) -> None:
        """Connect, and serve until cancelled, dead, or the robot closes (``events`` say which); once per object."""
        loop, since = asyncio.get_running_loop(), time.time()
        async with connected(host, port, STAMPED) as self._tcp:
            self._tcp.setblocking(True)  # for the thread that reads
            self._robot = self._tcp.getpeername()
            reader = StreamReader(self._tcp, since, lambda read: loop.call_soon_threadsafe(self._arrive, "tcp", read))
            reader.start()
            try:
                await self._work()
            except asyncio.CancelledError:
                self._event("cancelled")
                raise
            finally:
                self._phase = _Phase.ENDED
                self._close(self._tcp, reader, loop)

    async def _work(self) -> None:
        try:
            async with asyncio.TaskGroup() as self._tasks:
                self._tasks.create_task(self._converse())
        except* Ended:
            self._event(f"died: {self.death}" if self.death else "ended")

    def _close(self, tcp: socket.socket, reader: StreamReader, loop: asyncio.AbstractEventLoop) -> None:
        with contextlib.suppress(OSError):
            tcp.shutdown(socket.SHUT_RDWR)  # ends the read of the thread
        reader.join()
        if self._udp is not None:
            loop.remove_reader(self._udp.fileno())
            self._udp.close()

    # What the operator does

    def mode(self, value: Literal[1, 2, 3]) -> None:
        """Send 10: 1 none, 2 joystick, 3 AI."""
        self.send(wire.MODE, struct.pack("<i", value))

    def move(self, x: float, y: float, speed: float = 1.0) -> None:
        """Hold the stick in a direction: 11, at once and repeated."""
        self._hold(wire.MOVE, struct.pack("<3f", x, y, speed))

    def rotate(self, speed: float) -> None:
        """Hold the turning stick: 12, + right, at once and repeated."""
        self._hold(wire.ROTATE, struct.pack("<f", speed))

    def idle(self) -> None:
        """Let the stick go: 13, at once and repeated."""
        self._hold(wire.STOP, b"")

    stop = idle

    def move_ai(self, body: bytes) -> None:
        """Send 21."""
        self.send(wire.MOVE_AI, body)

    def ask_map(self) -> None:
        """Send 52."""
        self.send(wire.GET_MAP)

    def ask_position(self) -> None:
        """Send 54."""
        self.send(wire.GET_POSITION)

    def lidar(self, on: bool) -> None:
        """Send 50."""
        self.send(wire.LIDAR_MODE, struct.pack("<i", 1 if on else 2))

    def say(self, text: str) -> None:
        """Send 1."""
        self.send(wire.DEBUG, wire.string(text))

    def chat(self, body: bytes) -> None:
        """Send 40."""
        self.send(wire.CHAT, body)

    def feed(self, ranges: Sequence[float]) -> None:
        """Send 61, simulated lidar data."""
        self.send(wire.SCAN, struct.pack(f"<i{len(ranges)}f", len(ranges), *ranges))

    def send(self, kind: int, body: bytes = b"") -> None:
        """Send a packet the way this version does; before the session is established and after its end it is lost.

        1.3 sends 11, 12 and 61 by UDP whatever was agreed ("The gateway as robot"); the others where it was agreed.
        """
        if self._phase is not _Phase.ESTABLISHED:
            self._event(f"lost: packet {kind} while {self._phase.name.lower()}")
            return
        self._asked.add(kind)
        if kind in wire.BY_UDP and (self._works or self.version == "1.3"):
            self._send_datagram(kind, body)
        else:
            self._send_tcp(kind, body)

    def _hold(self, kind: int, body: bytes) -> None:
        self._stick = (kind, body)
        self.send(kind, body)

    def _send_tcp(self, kind: int, body: bytes = b"") -> None:
        assert self._tcp is not None
        data = wire.packet(kind, body, self.client_id)
        try:
            sent = self._tcp.send(data, socket.MSG_DONTWAIT)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            return self._event(f"lost: packet {kind}, the connection broke: {error!r}")
        if sent < len(data):
            self._event(f"hung up: the robot reads nothing, {sent} of {len(data)} bytes of packet {kind} were taken")
            with contextlib.suppress(OSError):
                self._tcp.shutdown(socket.SHUT_RDWR)
        return None

    def _send_datagram(self, kind: int, body: bytes = b"") -> None:
        if self._udp is None:
            return self._event(f"lost: packet {kind} by UDP, the robot never sent 4")
        with contextlib.suppress(OSError):
            self._udp.sendto(wire.packet(kind, body, self.client_id), self._robot)
        return None

    # What arrives

    def _arrive(self, channel: Channel, read: Read) -> None:
        try:
            self._inbox.put_nowait((channel, read))
        except asyncio.QueueFull:
            self._event(f"{_WAITING} reads wait, one was dropped")

    def _hear(self) -> None:
        """Take datagrams from the robot's own address and port, no others ("Handshake", Ports)."""
        assert self._udp is not None
        with contextlib.suppress(OSError):
            while True:
                data, source = self._udp.recvfrom(_DATAGRAM_BYTES)
                if source == self._robot:
                    self._arrive("udp", Read(time.monotonic(), data))
                else:
                    self._event(f"a datagram from {source[0]}:{source[1]}, not from the robot: {show(data)}")

    async def _converse(self) -> None:
        while True:
            channel, read = await self._inbox.get()
            if channel == "udp":
                received = wire.datagram(read.data)
                if received is None:
                    self._die(f"a datagram whose length field is wrong: {show(read.data)}")
                self._take(received, channel, read.at)
            elif read.data:
                self._read(read)
            else:
                why = read.why or "the robot closed the connection"
                self._event(why)
                raise Ended(why)

    def _read(self, read: Read) -> None:
        """Take one read as one packet ("The gateway as robot")."""
        if len(read.data) < _SMALLEST_READ:
            self._violate(f"a read of {len(read.data)} bytes, taken as a disconnect: {show(read.data)}")
            why = "hung up: took a short read as a disconnect"
            self._event(why)
            raise Ended(why)
        received, problem = self._reads.take(read.data)
        late = f" (this process read {read.late_s * 1000:.0f} ms late)"
        if self._reads.hopeless:
            self._die(problem)
        if received is not None:
            self._take(received, "tcp", read.at)
        elif self._reads.joined and read.late_s >= self._excuse_s(len(self._reads.joined)):
            self._event(f"joined by this process: {problem}{late}")
            for packet in self._reads.joined:
                self._take(packet, "tcp", read.at)
        elif problem:
            self._violate(problem + late * (read.late_s > 0.002))

    def _excuse_s(self, packets: int) -> float:
        """Give how late the reader must have been to be at fault itself for joining so many spaced packets."""
        return 0.8 * self._times.gap_s * (packets - 1)

    # Packets

    def _take(self, packet: Packet, channel: Channel, at: float) -> None:
        kind, body = packet.kind, packet.body
        raw = f"{channel} packet {kind}, body {show(body)}"
        self.received.append((at, channel, kind, body))
        del self.received[: -self._keep]
        self.counts[kind] += 1
        if kind not in wire.KNOWN_TO_HQ[self.version]:
            self._die(f"unknown packet id {kind} for an HQ {self.version}: {raw}")
        if problem := wire.hq_body_problem(kind, body):
            self._die(f"{problem}: {raw}")
        if packet.sender != wire.SERVER_ID:
            self._violate(f"id byte {packet.sender} instead of {wire.SERVER_ID}: {raw}")
        if (due := self._channel(kind, body)) not in (channel, None):
            self._violate(f"packet {kind} by {channel.upper()} instead of {due.upper()}: {raw}")
        if problem := self._untimely(kind):
            return self._violate(f"{problem}: {raw}")
        if problem := wire.hq_value_problem(kind, body, self.settings.side if self.settings else 0):
            self._violate(f"{problem}: {raw}")
        return self._obey(kind, body)

    def _channel(self, kind: int, body: bytes) -> Channel | None:
        """Tell what must carry a packet ("Packets"); None: either, as without a 6 nothing was agreed."""
        if kind == wire.UDP_ANSWER:
            return "udp" if any(body) else "tcp"  # 6(false) is a violation by itself
        if kind in wire.BY_UDP and self._udp is not None:
            return None if self._works is None else "udp" if self._works else "tcp"
        return "tcp"

    def _untimely(self, kind: int) -> str:
        """Tell why a packet is not due, empty if it is ("Handshake", "Translation")."""
        phase = self._phase
        if (kind == wire.SERVER_SETTINGS) != (phase is _Phase.CONNECTED):
            return "a second 2" if kind == wire.SERVER_SETTINGS else f"packet {kind} before the settings 2"
        if kind == wire.START_UDP:
            if self._udp is not None:
                return "a second 4"
            return "" if phase is _Phase.ANSWERED else "a 4 before the answer 3, or not both set the UDP flag"
        if kind == wire.UDP_ANSWER:
            return "" if self._udp is not None and not self._answered else "a 6 that is not due"
        if kind == wire.GET_SCAN and not self._lidar_sim:
            return "a 60 though LidarSim was not announced"
        question = wire.ANSWERS.get(kind)
        if question is not None and not self._unasked and question not in self._asked:
            return f"a {kind} to an HQ 1.1 that never asked ({question}): it has no handler"
        refusal = kind == wire.DEBUG and phase is _Phase.ANSWERED  # "No common version: say so"
        due = refusal or phase in (_Phase.CONNECTED, _Phase.ESTABLISHED)
        return "" if due else f"packet {kind} before the session was established"

    def _obey(self, kind: int, body: bytes) -> None:
        if kind == wire.SERVER_SETTINGS:
            self._greet(body)
        elif kind == wire.START_UDP:
            self._probe()
        elif kind == wire.UDP_ANSWER:
            self._conclude(any(body))
        elif kind == wire.DEBUG:
            self.texts.append(body[4:].decode("ascii"))
            del self.texts[: -self._keep]
        elif kind == wire.LIDAR_STATUS:
            self.lidar_on = body[0] == 1
        elif kind == wire.POSITION:
            x, y, heading = struct.unpack("<3f", body)
            self.position = (x, y, heading)
        elif kind == wire.MAP:
            self.map = body[4:] or self.map

    # Handshake

    def _greet(self, body: bytes) -> None:
        """Read the robot's settings and answer 3 a little later ("Settings and version negotiation")."""
        try:
            told = wire.announced(body, self.version, skips_map_flag=self._skips)
        except ValueError as error:
            self._die(f"{error}: packet 2, body {show(body)}")
        self.settings, self._phase = told, _Phase.GREETED
        if problem := wire.announced_problem(told, skips_map_flag=self._skips):
            self._violate(f"{problem}: packet 2, body {show(body)}")
        if not told.understood:
            self._event(f"keeps its old flags: it does not understand the versions {told.versions!r}")
        elif (told.map_size, told.map_interval) != told.meant:
            self._event(f"sees a wrong map size {told.map_size} with the interval {told.map_interval}")
        self._start(self._answer(told))

    async def _answer(self, told: wire.Announced) -> None:
        await asyncio.sleep(self._times.answer_s)
        flags = bytearray(wire.FLAGS[self.version])
        flags[Feature.UDP] = self._offers_udp
        if self._lidar_sim:
            flags[Feature.LIDAR_SIM] = True
        self._send_tcp(wire.CLIENT_SETTINGS, wire.string(wire.HQ_SENT[self.version]) + flags)
        self._phase = _Phase.ANSWERED
        if not (self._offers_udp and told.udp):
            return self._establish()
        await asyncio.sleep(self._times.probe_s)
        if self._udp is None:
            self._event(f"no 4 within {self._times.probe_s:g} s of the 3")
        return None

    def _probe(self) -> None:
        """Open the UDP socket, only now, and send 5 once ("Handshake" 4)."""
        assert self._tcp is not None
        self._phase = _Phase.PROBING
        self._udp = socket.socket(self._tcp.family, socket.SOCK_DGRAM)
        self._udp.setblocking(False)
        self._bind(self._udp, self._tcp.getsockname()[0])
        asyncio.get_running_loop().add_reader(self._udp.fileno(), self._hear)
        self._send_datagram(wire.UDP_PROBE)
        self._start(self._wait())

    def _bind(self, sock: socket.socket, host: str) -> None:
        """Bind the UDP port; several programs of one machine cannot all have the deployed one."""
        try:
            sock.bind((host, DEPLOYED_PORT if self._udp_port is None else self._udp_port))
        except OSError as error:
            if self._udp_port is not None or error.errno != errno.EADDRINUSE:
                raise
            sock.bind((host, 0))
            self._event(f"UDP port {DEPLOYED_PORT} is taken, {sock.getsockname()[1]} instead")

    async def _wait(self) -> None:
        await asyncio.sleep(self._times.probe_s)
        if not self._answered:
            self._event(f"no 6 within {self._times.probe_s:g} s of the 5")
        self._report()

    def _conclude(self, works: bool) -> None:
        """Take 6: programs of 1.1 and 1.2 believe in UDP after any ("The gateway as robot")."""
        self._answered = True
        self._works = works or self.version != "1.3"
        if not works:
            self._violate("6(false): a listener sends 6(true) or none")
        self._report()

    def _report(self) -> None:
        """Send 7: whether a 6 came; 1.3 says true all the same ("Handshake" 6)."""
        if self._phase is _Phase.PROBING:
            connected = self._answered or self.version == "1.3"
            if not connected:
                self._works = False
            self._send_tcp(wire.UDP_STATUS, bytes([connected]))
            self._establish()

    def _establish(self) -> None:
        self._phase = _Phase.ESTABLISHED
        self.established.set()
        if self._repeat_s is not None:
            self._start(self._repeat(self._repeat_s))

    async def _repeat(self, period_s: float) -> None:
        """Repeat the stick, 13 while idle ("Packets")."""
        while True:
            self.send(*self._stick)
            await asyncio.sleep(period_s)

    def _start(self, work: Coroutine[None, None, None]) -> None:
        assert self._tasks is not None
        self._tasks.create_task(work)
