"""A simulated HQ program as fragile as the legacy ones: the judge of a gateway that plays robot."""

from __future__ import annotations

import asyncio
import contextlib
import enum
import errno
import socket
import struct
import time
from collections import Counter
from collections.abc import Iterable

import msgspec

from gateways.tcpudp.conformance import parser as wire
from gateways.tcpudp.conformance.operator import OperatorProgram
from gateways.tcpudp.conformance.parser import Channel, FeatureFlag, ParsedPacket
from zbridge.simulation.fragile import Work
from zbridge.simulation.judge import Ended, show
from zbridge.simulation.timing import STAMPED, Read, ReadingThread

_SMALLEST_READ = 6
_WAITING = 1000
DEPLOYED_PORT = 11000
"""The UDP port that legacy programs bind ("Whose datagrams count")."""


class _HqPhase(enum.Enum):
    CONNECTED = enum.auto()
    GREETED = enum.auto()
    ANSWERED = enum.auto()
    PROBING = enum.auto()
    ESTABLISHED = enum.auto()
    ENDED = enum.auto()


class HqTimes(msgspec.Struct, frozen=True, kw_only=True):
    """The HQ's times in seconds; the defaults are those of the legacy HQ programs."""

    answer_s: float = 0.015
    """From packet 2 to the answer 3 (as captured)."""
    probe_s: float = 2.0
    """How long it waits for 4 and, after its 5, for 6."""
    gap_s: float = 0.01
    """Spacing of the robot's packets that exculpates it where this process read later than that."""


_DEPLOYED = HqTimes()


class FragileTcpUdpHq(OperatorProgram):
    """An HQ program of one version, for one connection: records every violation and dies of the deadly ones.

    ``lidar_sim``: announce LidarSim; ``skips_map_flag``: read the map's size where the SLAMMap flag is;
    ``unasked``: a 1.1 program has handlers for 53 and 55 before it asked, unlike the first programs of 1.1;
    ``repeat_s``: seconds between repetitions of the stick, None for a viewer that sends nothing by itself;
    ``udp_port``: the port to bind, 0 for any; None: the legacy one, or any if that is taken. A row of ``received``:
    monotonic seconds, channel, id, body.
    """

    OPTIONS = STAMPED
    _phase: _HqPhase

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
        times: HqTimes = _DEPLOYED,
    ) -> None:
        if version not in wire.HQ_SENT or (lidar_sim and wire.FLAGS[version] <= FeatureFlag.LIDAR_SIM):
            raise ValueError(f"no HQ of version {version}" + " announces LidarSim" * lidar_sim)
        super().__init__()
        self.version = version
        self.established = asyncio.Event()
        self.settings: wire.RobotAnnouncement | None = None
        self.position: tuple[float, float, float] | None = None
        self.map: bytes | None = None
        self.lidar_on: bool | None = None
        self.texts: list[str] = []
        self.counts: Counter[int] = Counter()
        self._offers_udp, self._lidar_sim, self._skips = udp, lidar_sim, skips_map_flag
        self._unasked = unasked or version != "1.1"
        self._asked: set[int] = set()
        self._repeat_s, self._udp_port, self._times = repeat_s, udp_port, times
        self._phase = _HqPhase.CONNECTED
        self._reads = wire.ReadChecker(wire.HQ_LOSES_BYTES - 1)
        self._inbox: asyncio.Queue[tuple[Channel, Read]] = asyncio.Queue(_WAITING)
        self._robot: tuple[str, int] = ("", 0)
        self._udp: socket.socket | None = None
        self._answered = False
        self._works: bool | None = None

    @property
    def client_id(self) -> int:
        """The id the robot gave, 0 before that."""
        return self.settings.client if self.settings else 0

    @property
    def agreed(self) -> str:
        settings = self.settings
        if settings is None or not self.established.is_set():
            return ""
        features = ", ".join(feature.name.lower() for feature in sorted(settings.features)) or "none"
        return f"established: client id {settings.client}, robot of {settings.versions}, features {features}"

    def shown(self) -> str:
        position = "no position" if self.position is None else "position {:.2f} {:.2f} {:.1f}".format(*self.position)
        cells = f"a map of {len(self.map)} cells" if self.map else "no map"
        return ", ".join([position, cells, *(f"text {text!r}" for text in self.texts[-1:])])

    async def run(self, host: str, port: int) -> None:
        """Connect, and serve until cancelled, dead, or the robot closes; once per object."""
        self._since = time.time()
        await super().run(host, port)

    def _work(self) -> Iterable[Work]:
        loop, tcp = asyncio.get_running_loop(), self._tcp
        tcp.setblocking(True)  # for the thread that reads
        self._robot = tcp.getpeername()

        def give(read: Read) -> None:
            loop.call_soon_threadsafe(self._arrive, "tcp", read)

        self._thread = ReadingThread(tcp, self._since, give)
        self._thread.start()
        return (self._converse(),)

    def _before_close(self) -> None:
        self._phase = _HqPhase.ENDED
        self._shut()  # ends the read of the thread
        self._thread.join()
        if self._udp is not None:
            asyncio.get_running_loop().remove_reader(self._udp.fileno())
            self._udp.close()

    # What it sends

    def send(self, kind: int, body: bytes = b"") -> None:
        """Send a packet the way this version does; before the session is established and after its end it is lost.

        1.3 sends 11, 12 and 61 by UDP whatever was agreed ("Datagrams, and whose they are" in ``fragile-robots.md``);
        the others where it was agreed.
        """
        if self._phase is not _HqPhase.ESTABLISHED:
            self._event(f"lost: packet {kind} while {self._phase.name.lower()}")
            return
        self._asked.add(kind)
        if kind in wire.BY_UDP and (self._works or self.version == "1.3"):
            self._send_datagram(kind, body)
        else:
            self._send_tcp(kind, body)

    def _send_tcp(self, kind: int, body: bytes = b"") -> None:
        data = wire.packet(kind, body, self.client_id)
        try:
            sent = self._tcp.send(data, socket.MSG_DONTWAIT)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            return self._event(f"lost: packet {kind}, the connection broke: {error!r}")
        if sent < len(data):
            self._event(f"hung up: the robot reads nothing, {sent} of {len(data)} bytes of packet {kind} were taken")
            self._shut()
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

    def _read_datagrams(self) -> None:
        """Take datagrams from the robot's own address and port, no others ("Links")."""
        assert self._udp is not None
        with contextlib.suppress(OSError):
            while True:
                data, source = self._udp.recvfrom(wire.DATAGRAM_BYTES)
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
                self._judge(received, channel, read.at)
            elif read.data:
                self._read_packet(read)
            else:
                raise Ended(read.why or "the robot closed the connection")

    def _read_packet(self, read: Read) -> None:
        """Take one read as one packet ("One packet per read" in ``fragile-robots.md``)."""
        if len(read.data) < _SMALLEST_READ:
            self._violate(f"a read of {len(read.data)} bytes, taken as a disconnect: {show(read.data)}")
            raise Ended("hung up: took a short read as a disconnect")
        received, problem = self._reads.check(read.data)
        late = f" (this process read {read.late_s * 1000:.0f} ms late)"
        if self._reads.hopeless:
            self._die(problem)
        excuse_s = 0.8 * self._times.gap_s * (len(self._reads.joined) - 1)
        if received is not None:
            self._judge(received, "tcp", read.at)
        elif self._reads.joined and read.late_s >= excuse_s:  # so late that it may have joined spaced packets itself
            self._event(f"joined by this process: {problem}{late}")
            for packet in self._reads.joined:
                self._judge(packet, "tcp", read.at)
        elif problem:
            self._violate(problem + late * (read.late_s > 0.002))

    # Packets

    def _judge(self, packet: ParsedPacket, channel: Channel, at: float) -> None:
        kind, body = packet.kind, packet.body
        raw = f"{channel} packet {kind}, body {show(body)}"
        self.received.append((at, channel, kind, body))
        self.counts[kind] += 1
        if kind not in wire.KNOWN_TO_HQ[self.version]:
            self._die(f"unknown packet id {kind} for an HQ {self.version}: {raw}")
        if problem := wire.body_problem(kind, body):
            self._die(f"{problem}: {raw}")
        if packet.sender != wire.SERVER_ID:
            self._violate(f"id byte {packet.sender} instead of {wire.SERVER_ID}: {raw}")
        if (due := wire.due_channel(kind, body, offered=self._udp is not None, works=self._works)) not in (
            channel,
            None,
        ):
            self._violate(f"packet {kind} by {channel.upper()} instead of {due.upper()}: {raw}")
        if not self._report(self._untimely(kind), raw):
            self._report(wire.value_problem(kind, body, self.settings.side if self.settings else 0), raw)
            self._obey(kind, body)

    def _untimely(self, kind: int) -> str:
        """Return why a packet is not due, or nothing ("The handshake with an HQ program", "Towards HQ programs")."""
        phase = self._phase
        if (kind == wire.SERVER_SETTINGS) != (phase is _HqPhase.CONNECTED):
            return "a second 2" if kind == wire.SERVER_SETTINGS else f"packet {kind} before the settings 2"
        if kind == wire.START_UDP:
            if self._udp is not None:
                return "a second 4"
            return "" if phase is _HqPhase.ANSWERED else "a 4 before the answer 3, or not both set the UDP flag"
        if kind == wire.UDP_ANSWER:
            return "" if self._udp is not None and not self._answered else "a 6 that is not due"
        if kind == wire.GET_SCAN and not self._lidar_sim:
            return "a 60 though LidarSim was not announced"
        question = wire.ANSWERS.get(kind)
        if question is not None and not self._unasked and question not in self._asked:
            return f"a {kind} to an HQ 1.1 that never asked ({question}): it has no handler"
        refusal = kind == wire.DEBUG and phase is _HqPhase.ANSWERED  # no common version ("Versions and dialects")
        due = refusal or phase in (_HqPhase.CONNECTED, _HqPhase.ESTABLISHED)
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
            del self.texts[: -self.KEEP]
        elif kind == wire.LIDAR_STATUS:
            self.lidar_on = body[0] == 1
        elif kind == wire.POSITION:
            x, y, heading = struct.unpack("<3f", body)
            self.position = (x, y, heading)
        elif kind == wire.MAP:
            self.map = body[4:] or self.map

    # Handshake

    def _greet(self, body: bytes) -> None:
        """Read the robot's settings and answer 3 a little later ("The handshake with an HQ program")."""
        try:
            settings = wire.announced(body, self.version, skips_map_flag=self._skips)
        except ValueError as error:
            self._die(f"{error}: packet 2, body {show(body)}")
        self.settings, self._phase = settings, _HqPhase.GREETED
        self._report(wire.announced_problem(settings, skips_map_flag=self._skips), f"packet 2, body {show(body)}")
        if not settings.understood:
            self._event(f"keeps its old flags: it does not understand the versions {settings.versions!r}")
        elif (settings.map_size, settings.map_interval) != settings.meant:
            self._event(f"sees a wrong map size {settings.map_size} with the interval {settings.map_interval}")
        self._start(self._answer(settings))

    async def _answer(self, settings: wire.RobotAnnouncement) -> None:
        await asyncio.sleep(self._times.answer_s)
        flags = bytearray(wire.FLAGS[self.version])
        flags[FeatureFlag.UDP] = self._offers_udp
        if self._lidar_sim:
            flags[FeatureFlag.LIDAR_SIM] = True
        self._send_tcp(wire.CLIENT_SETTINGS, wire.string(wire.HQ_SENT[self.version]) + flags)
        self._phase = _HqPhase.ANSWERED
        if not (self._offers_udp and settings.udp):
            return self._establish()
        await asyncio.sleep(self._times.probe_s)
        if self._udp is None:
            self._event(f"no 4 within {self._times.probe_s:g} s of the 3")
        return None

    def _probe(self) -> None:
        """Open the UDP socket, only now, and send 5 once ("Handshake")."""
        self._phase = _HqPhase.PROBING
        self._udp = socket.socket(self._tcp.family, socket.SOCK_DGRAM)
        self._udp.setblocking(False)
        host, port = self._tcp.getsockname()[0], DEPLOYED_PORT if self._udp_port is None else self._udp_port
        try:
            self._udp.bind((host, port))
        except OSError as error:  # several programs of one machine cannot all have the deployed port
            if self._udp_port is not None or error.errno != errno.EADDRINUSE:
                raise
            self._udp.bind((host, 0))
            self._event(f"UDP port {port} is taken, {self._udp.getsockname()[1]} instead")
        asyncio.get_running_loop().add_reader(self._udp.fileno(), self._read_datagrams)
        self._send_datagram(wire.UDP_PROBE)
        self._start(self._wait())

    async def _wait(self) -> None:
        await asyncio.sleep(self._times.probe_s)
        if not self._answered:
            self._event(f"no 6 within {self._times.probe_s:g} s of the 5")
        self._send_status()

    def _conclude(self, works: bool) -> None:
        """Take 6: programs of 1.1 and 1.2 believe in UDP after any ("Whose datagrams count")."""
        self._answered = True
        self._works = works or self.version != "1.3"
        if not works:
            self._violate("6(false): a listener sends 6(true) or none")
        self._send_status()

    def _send_status(self) -> None:
        """Send 7: whether a 6 came; 1.3 says true all the same ("Whose datagrams count")."""
        if self._phase is _HqPhase.PROBING:
            connected = self._answered or self.version == "1.3"
            if not connected:
                self._works = False
            self._send_tcp(wire.UDP_STATUS, bytes([connected]))
            self._establish()

    def _establish(self) -> None:
        self._phase = _HqPhase.ESTABLISHED
        self.established.set()
        if self._repeat_s is not None:
            self._start(self._repeat(self._repeat_s))

    async def _repeat(self, period_s: float) -> None:
        """Repeat the stick, 13 while idle ("Stops are repeated" in ``fragile-robots.md``)."""
        while True:
            self.send(*self._stick)
            await asyncio.sleep(period_s)
