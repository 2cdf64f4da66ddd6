"""Sessions of the TCP/UDP package protocol in both roles: handshake, identities, what may be sent. Sans-IO.

Source: "Handshake", "Settings and version negotiation" and "The gateway as HQ" of the protocol page.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable

from gateways.tcpudp.messages import (
    HEADER,
    MAX_FRAME,
    PACKETS,
    SERVER_ID,
    Carrier,
    ClientControllMode,
    ClientGetPosition,
    ClientGetSLAMMap,
    ClientLidarMode,
    ClientSettings,
    ClientUDPConnection,
    ClientUDPConnectionStatus,
    DebugMessage,
    OpaquePacket,
    Packet,
    Sender,
    ServerSettings,
    ServerStartUDP,
    ServerUDPConnection,
    decoder,
    encode_packet,
    frame_end,
    read_header,
)
from gateways.tcpudp.settings import HQ_BLOCKS, ROBOT_BLOCKS, Feature, Settings, read_settings
from gateways.tcpudp.signs import LOOK_AGAIN_S, LOOK_S, Signs
from gateways.tcpudp.versions import ANNOUNCED, LISTED, VERSIONS, announced
from zbridge.protocol import (
    LIMIT,
    Datagram,
    EncodeError,
    Limits,
    Malformed,
    NotReady,
    Probe,
    ProtocolError,
    Role,
    Session,
    State,
    Unsupported,
    Verdict,
    agree,
    newest,
    parse_versions,
)

MAX_WRITE = 4096
"""Bytes of the longest packet a deployed robot reads whole."""
HANDSHAKE_S = 5.0
PROBE_S = 2.0
"""Seconds each end waits for the other's datagram."""
REPORT_S = 3.0
"""Seconds an HQ has for packet 7: it may wait :data:`PROBE_S` for a 6 that was lost."""
SILENCE_S = 2.5
"""Seconds after packet 4 in which a robot may get nothing by TCP but one packet 7: it sleeps 2 s, and may be late."""
CLIENT_PORT = 11000
"""The UDP port that deployed HQ programs bind."""
RIVAL = "another source of datagrams claims to be this client"
LATE_START = "handshaking"
AGAIN_S = 0.3
"""Seconds after which what is sent once and matters is sent again to robots that misread a tenth of what they get."""
_QUOTED = 80
_AUTONOMOUS = 3
_MODE_AGAIN, _LIDAR_AGAIN = "mode again", "lidar again"
_MISREADING = frozenset({"1.1", "1.2"})
_ANSWERED = (ClientGetSLAMMap, ClientGetPosition)


def limits(gap_s: float) -> Limits:
    """Give the bounds of a session that leaves ``gap_s`` seconds between two packets."""
    return Limits(frame_bytes=MAX_FRAME, handshake_s=HANDSHAKE_S, gap_s=gap_s)


Decode = Callable[[bytes, int], Packet]


def decoders(own: Sender, peer_ids: Iterable[int]) -> dict[bytes, Decode]:
    """Tabulate, by ``id`` byte and packet id, how to read what a peer may send to the side ``own``."""
    packet_ids = [number for number in range(256) if number not in PACKETS or PACKETS[number].sender is not own]
    return {bytes((peer_id, number)): decoder(number) for peer_id in peer_ids for number in packet_ids}


class _TcpUdpSession(Session[Packet]):
    """What both roles share: framing, and the ``id`` byte of what they send."""

    frame_end = staticmethod(frame_end)
    sender_id: int
    """The ``id`` byte of what we send."""
    _decoders: dict[bytes, Decode]

    def encode(self, message: Packet) -> bytes:
        frame = encode_packet(message, self.sender_id)
        if self.transport == "udp" and not isinstance(message, OpaquePacket):
            return Datagram(frame) if message.spec.carrier is Carrier.UDP_IF_AGREED else frame
        return frame

    def decode(self, frame: bytes) -> Packet:
        """Read a packet of the stream; ``frame_end`` has checked its length."""
        decode = self._decoders.get(frame[4:6])
        if decode is None:
            raise ProtocolError(self._odd(frame[4], frame[5]))
        return decode(frame, HEADER.size)

    def _odd(self, sender_id: int, packet_id: int) -> str:
        """Say why the peer may not send a packet like this."""
        spec = PACKETS.get(packet_id)
        if spec is not None and spec.sender is _OWN[self.role]:
            return f"{spec.name} ({packet_id}) from the wrong side"
        return f"packet {packet_id} with id {sender_id}, which is not the peer's"

    def refuse_versions(self, listed: str, ours: Iterable[str], now: float) -> None:
        """Tell the peer and the operator that no version is common, and close."""
        reason = f"no common version: the peer speaks {listed[:_QUOTED]!r}, this gateway {', '.join(ours)}"
        self.send(DebugMessage(reason))
        self.close(reason, now)


_OWN = {Role.HQ: Sender.HQ, Role.ROBOT: Sender.ROBOT}


class _Chosen(bytes):
    """A packet 10 that was commanded; the 1 of a stop is none."""

    @property
    def autonomous(self) -> bool:
        """Whether the robot's own program is to drive."""
        return self[HEADER.size] == _AUTONOMOUS


class HqSession(_TcpUdpSession):
    """We play HQ towards a robot.

    ``udp``: offer datagrams. ``force``: features and packet ids to use although it does not announce them.
    ``announce``: the features that we announce. ``predecessor``: the session of the connection before.
    """

    role = Role.HQ
    handled = frozenset({ServerSettings, ServerStartUDP, ServerUDPConnection, DebugMessage})
    _decoders = decoders(Sender.HQ, (SERVER_ID,))

    def __init__(
        self,
        limits: Limits,
        *,
        udp: bool = True,
        force: Iterable[Feature | int] = (),
        announce: Iterable[Feature] = ANNOUNCED,
        predecessor: HqSession | None = None,
    ) -> None:
        super().__init__(limits)
        self.sender_id = 0
        self.settings: Settings | None = None
        self.autonomous: bool = predecessor is not None and predecessor.autonomous
        """Whether mode 3 was sent, on this connection or one before, and no other mode was commanded since."""
        self._announce = frozenset(announce)
        self._udp = udp and Feature.UDP in self._announce
        self._force = frozenset(force)
        self._allowed: set[type[Packet]] = set()
        """Classes of packets that this robot's settings were found to allow."""
        self._agreed = ""
        self._start = Probe(PROBE_S)
        self._probe = Probe(PROBE_S)
        self._answered: bool | None = None
        """Whether the robot got our datagram and we its answer; None where none was sent."""
        self._silent_until = math.inf
        self._chosen: _Chosen | None = None
        """The mode that was commanded last."""
        self._raw: deque[bytes] = deque(maxlen=LIMIT)
        """The packets that nobody here can read, as they were queued: as many as can wait."""
        self._signs: Signs = Signs(predecessor._signs if predecessor is not None else None)
        self._look_at = math.inf
        self._others = 0
        """Packets that came and are no telemetry."""

    def overdue(self) -> str:
        if self.last_malformed is not None:
            return f"no settings that can be read within {self.limits.handshake_s:g} s: {self.last_malformed}"
        return (
            f"connected, but no settings within {self.limits.handshake_s:g} s: "
            "its one connection may be used up, restart the robot program"
        )

    def accept(self, message: Packet, now: float) -> bool:
        if isinstance(message, ServerSettings):
            self._take_settings(message, now)
        elif self.settings is None:
            raise ProtocolError(f"{type(message).__name__} before serverSettings")
        elif isinstance(message, ServerStartUDP):
            self._take_start(now)
        elif isinstance(message, ServerUDPConnection):
            self._take_answer(message, now, by_datagram=False)
        else:
            self._others += isinstance(message, DebugMessage)
            return True
        self._others += 1
        return False

    def accept_datagram(self, message: Packet, now: float) -> bool:
        if isinstance(message, ServerUDPConnection):
            self._take_answer(message, now, by_datagram=True)
            self._others += 1
            return False
        return self.accept(message, now)

    # What may be sent

    def may_send(self, message: Packet) -> None:
        """Raise Refused for a packet that this robot may not know: an unregistered id crashes it."""
        if type(message) in self._allowed:
            return
        packet_id = message.id if isinstance(message, OpaquePacket) else message.spec.id
        if packet_id in self._force:
            return
        if isinstance(message, OpaquePacket):
            raise Unsupported(f"packet {packet_id} may crash the robot; list it in options.force if it knows it")
        needed = message.spec.features
        if not needed or not self._force.isdisjoint(needed):
            return
        # Of several features the first one that the robot's version has a flag for decides.
        feature = next((feature for feature in needed if hasattr(self.settings, feature.value)), None)
        if feature is None:
            names = " or ".join(feature.value for feature in needed)
            raise Unsupported(f"{message.spec.name}: version {self._agreed} has no {names}")
        if not getattr(self.settings, feature.value):
            raise Unsupported(f"{message.spec.name}: the robot does not announce {feature.value}")
        self._allowed.add(type(message))

    def encode(self, message: Packet) -> bytes:
        """Write a packet the robot can take whole; raise Refused for one it may not know."""
        self.may_send(message)
        if isinstance(message, DebugMessage) and not message.text:
            raise Malformed("an empty text crashes the robot")
        frame = super().encode(message)
        if len(frame) > MAX_WRITE:
            raise EncodeError(f"packet of {len(frame)} bytes, the robot reads {MAX_WRITE} at most")
        return frame

    # What is sent once and matters

    def choose_mode(self, mode: int, now: float) -> None:
        """Send a control mode that was commanded."""
        frame = _Chosen(self.encode(ClientControllMode(mode)))
        self._send_surely(frame, _MODE_AGAIN, now)
        self._chosen = frame

    def switch_lidar(self, mode: int, now: float) -> None:
        """Send a lidar mode."""
        self._send_surely(self.encode(ClientLidarMode(mode)), _LIDAR_AGAIN, now)
        self._signs.asked(self._heard, 1 + self.outbox.is_set(_LIDAR_AGAIN))

    def _send_surely(self, frame: bytes, again: str, now: float) -> None:
        """Send a packet, to robots that misread some again; a newer one ends the repetition of an older one."""
        self.outbox.put(frame)
        if self._agreed in _MISREADING:
            self.outbox.set(again, (frame,), now + AGAIN_S)

    def send_nothing_again(self) -> None:
        """Drop what is still to be repeated: the robot is stopped."""
        self.outbox.clear(_MODE_AGAIN)
        self.outbox.clear(_LIDAR_AGAIN)

    def send_raw(self, packet: Packet) -> None:
        """Queue a packet that nobody here can read; raise Refused, EncodeError."""
        frame = self.encode(packet)
        self.outbox.put(frame)
        self._raw.append(frame)

    def withdraw_raw(self) -> None:
        """Forget the packets that nobody here can read and that still wait: they might move a robot after its stop."""
        waiting = len(self.outbox)
        while self._raw:
            self.outbox.unqueue(self._raw.popleft())
        self.traffic.dropped += waiting - len(self.outbox)

    def withdraw_autonomous(self) -> None:
        """Let no mode 3 leave any more, neither for the first time nor again."""
        if self._chosen is not None and self._chosen.autonomous:
            self.outbox.unqueue(self._chosen)
            self.outbox.clear(_MODE_AGAIN)

    def outgoing(self, now: float) -> bytes | None:
        frame = super().outgoing(now)
        if type(frame) is _Chosen:
            # A robot that may have misread another mode is in mode 3 until that was sent again.
            self.autonomous = frame.autonomous or (self.autonomous and self.outbox.is_set(_MODE_AGAIN))
        return frame

    def send(self, message: Packet) -> None:
        super().send(message)
        if isinstance(message, _ANSWERED):
            self._signs.asked(self._heard)

    # Handshake

    def _take_settings(self, message: ServerSettings, now: float) -> None:
        if self.settings is not None:
            raise ProtocolError("serverSettings a second time")
        self.sender_id = message.client_id
        self._doubt()
        listed = parse_versions(message.versions)
        agreed = agree(VERSIONS, listed)
        if agreed is None:
            self.refuse_versions(message.versions, VERSIONS, now)
            return
        self.settings = read_settings(message.versions, message.block, ROBOT_BLOCKS)
        self._agreed = agreed
        udp = self._udp and self.settings.udp
        answer = VERSIONS[agreed].answer or message.versions
        features = self._announce if udp else self._announce - {Feature.UDP}
        self.send_first(ClientSettings(answer, announced(answer, features)))
        if udp:
            self.lift_limit()
            self._start.begin(now)
        else:
            self._finish(now)

    def _take_start(self, now: float) -> None:
        """Packet 4: send 5 by UDP at once, and nothing by TCP but one 7 until the silence has ended."""
        if self._probe.verdict is not Verdict.UNKNOWN:
            raise ProtocolError("serverStartUDP a second time")
        offered = self._start.verdict is not Verdict.UNKNOWN
        if not self._start.settle(works=True):
            self.busy = LATE_START  # given up, or never offered: the robot sleeps all the same
        self._silent_until = now + SILENCE_S
        self.outbox.quiet(self._silent_until)
        if offered:
            self._answered = False
            self.outbox.put_exempt(Datagram(self.encode(ClientUDPConnection())))
        self._probe.begin(now)

    def _take_answer(self, message: ServerUDPConnection, now: float, *, by_datagram: bool) -> None:
        works = message.received and by_datagram
        self._answered = self._answered or works
        if not self._probe.settle(works=works):
            raise ProtocolError("serverUDPConnection was not due")
        self._report_probe(works=works)

    def _report_probe(self, *, works: bool) -> None:
        if works:
            self.transport = "udp"
        self.send_first(ClientUDPConnectionStatus(works))

    def _finish(self, now: float) -> None:
        assert self.settings is not None
        self.establish(self._agreed, tuple(feature.value for feature in self.settings.features))
        self._look_at = now + LOOK_S

    # Timers

    def timers(self) -> float:
        return min(self._start.deadline, self._probe.deadline, self._silent_until, self._look_at)

    def on_timer(self, now: float) -> None:
        if self._start.expire(now):
            self._finish(now)  # the robot wants no datagrams after all
        if self._probe.expire(now):
            self._report_probe(works=False)
        if now >= self._silent_until:
            self._silent_until = math.inf
            if self.state is State.HANDSHAKING:
                self._finish(now)
            elif self.busy == LATE_START:
                self.busy = None
        if now >= self._look_at:
            self._signs.look(self._heard, unanswered=self._answered is False)
            self._doubt()
            self._look_at = now + LOOK_AGAIN_S

    # Signs of a connection that is not the robot's one usable connection

    def malformed(self, what: str) -> None:
        super().malformed(what)
        self._doubt()

    @property
    def _heard(self) -> int:
        return self.traffic.frames_in - self.traffic.malformed - self._others

    def _doubt(self) -> None:
        self.doubts = self._signs.gather(self.sender_id, self.traffic)


_FROM_HQ: dict[int, Decode] = {
    number: decoder(number)
    for number in range(256)
    if number not in PACKETS or PACKETS[number].sender is not Sender.ROBOT
}
"""How to read what an HQ may send, by packet id."""
_NOBODYS_IDS = (0, SERVER_ID)
"""The ``id`` bytes that no client is given."""
_NO_HEADER = (-1, -1)
_HANDSHAKING, _ESTABLISHED = State.HANDSHAKING, State.ESTABLISHED
"""As plain names: every client of a host is asked about every datagram that is nobody's."""


def _header(datagram: bytes) -> tuple[int, int]:
    """Give the ``id`` byte and the packet id of a datagram that is one packet."""
    try:
        return read_header(datagram)
    except ProtocolError:
        return _NO_HEADER


class RobotSession(_TcpUdpSession):
    """We play the robot towards an HQ: what we announce, the versions we list verbatim, and the id we give it.

    ``block``: the settings block as it is sent, where that is not the one of ``settings``. ``known``: packet ids that
    this HQ knows besides those of its version. client_port: the UDP port that this HQ is known to bind; 0: none. The
    ``id`` byte of what it sends by TCP is not looked at: the connection tells who it is, and programs send 0 before
    they have read the settings.

    Datagrams tell nothing but their source, and any process of the HQ's host can send them. So there are two ways to
    become its source, and no others:

    - a 5 within :data:`PROBE_S` of our 4 and before its 7. If a second source sends one too, neither is heard: no 6 is
      sent, or the HQ is let go where it was sent already. Where no 5 came there is no 6 either: any 6, false too,
      makes programs of 1.1 and 1.2 believe in datagrams, and without one they fall back to TCP.
    - after the handshake, while it has no source, a packet with its id from ``client_port``: a program of 1.3 whose 5
      was lost sends 11, 12 and 61 by UDP all the same.

    A packet with its id from ``client_port`` while its source is another one shows that one of the two is not the HQ:
    neither is heard any more.
    """

    role = Role.ROBOT
    handled = frozenset({ClientSettings, ClientUDPConnection, ClientUDPConnectionStatus})
    sender_id = SERVER_ID

    def __init__(
        self,
        limits: Limits,
        settings: Settings,
        client_id: int,
        versions: Iterable[str] = LISTED,
        *,
        block: bytes | None = None,
        known: Iterable[int] = (),
        client_port: int = CLIENT_PORT,
    ) -> None:
        super().__init__(limits)
        self.settings = settings
        self.client_id = client_id
        self.client: Settings | None = None
        self.known: frozenset[int] = frozenset()
        """The packet ids that this HQ knows; one it does not know cripples it for good."""
        self._block = settings.encode() if block is None else block
        self._also_known = frozenset(known)
        self._versions = tuple(versions)
        self._agreed = ""
        self._probe = Probe(PROBE_S)
        self._report = Probe(REPORT_S)
        self._heard_until = -math.inf
        """Until when a 7 answers a 6 that was heard."""
        self._answer: Datagram | None = None
        """Packet 6, once it was queued."""
        self._client_port = client_port
        self._sourced = False
        """Whether datagrams come from a source that is taken for the HQ's."""
        self._port = 0
        """The port of that source."""
        self._contested = False
        """Whether two sources were taken for the HQ's after the handshake."""

    def decode(self, frame: bytes) -> Packet:
        """Read a packet of the stream; ``frame_end`` has checked its length."""
        decode = _FROM_HQ.get(frame[5])
        if decode is None:
            raise ProtocolError(self._odd(frame[4], frame[5]))
        return decode(frame, HEADER.size)

    def opened(self, now: float) -> None:
        self.send_first(ServerSettings(self.client_id, ",".join(self._versions), self._block))

    def accept(self, message: Packet, now: float) -> bool:
        if isinstance(message, ClientSettings):
            self._take_settings(message, now)
        elif self.client is None:
            raise ProtocolError(f"{type(message).__name__} before clientSettings")
        elif isinstance(message, ClientUDPConnectionStatus):
            if self.state is not State.HANDSHAKING:
                raise ProtocolError("clientUDPConnectionStatus was not due")
            self._take_report(works=message.connected and now < self._heard_until)
        elif isinstance(message, ClientUDPConnection):
            raise ProtocolError("clientUDPConnection by TCP")
        else:
            return True
        return False

    def claims(self, datagram: bytes, port: int) -> bool:
        """Claim a 5 between our 4 and its 7; later a packet with its id from its port."""
        if self.state is _ESTABLISHED:
            claims = port == self._client_port and not self._contested and self._claims_late(datagram)
        else:
            claims = self.state is _HANDSHAKING and self._claims_probe(datagram)
        if claims and not self._sourced:
            self._port = port
        return claims

    def _claims_probe(self, datagram: bytes) -> bool:
        if self._probe.verdict not in (Verdict.WAITING, Verdict.WORKS):
            return False
        sender_id, packet_id = _header(datagram)
        own = sender_id == self.client_id or sender_id in _NOBODYS_IDS
        return own and packet_id == ClientUDPConnection.spec.id

    def _claims_late(self, datagram: bytes) -> bool:
        if self._probe.verdict is Verdict.UNKNOWN or (self._sourced and self._port == self._client_port):
            return False
        sender_id, packet_id = _header(datagram)
        return sender_id == self.client_id and packet_id in _FROM_HQ

    def rivalled(self, now: float) -> None:
        """Hear neither source; let an HQ go that was told that its datagrams arrive, as it believes that."""
        answer, self._answer = self._answer, None
        self._probe.fail()
        self._sourced, self.transport = False, "tcp"
        self.left_out[RIVAL] += 1
        if self.state is State.ESTABLISHED:
            self._contested = True
        elif answer is not None and not self.outbox.withdraw(answer):
            self.close(RIVAL, now)
        else:
            self._report.begin(now)

    def stray(self, datagram: bytes) -> None:
        """Raise Refused where a packet bears this HQ's id and comes from where nobody knows it."""
        if self.state is State.ESTABLISHED and _header(datagram)[0] == self.client_id:
            self.traffic.foreign += 1
            text = "packets by UDP from another port than this client's are not taken"
            raise NotReady(f"{text} (client_port = {self._client_port})")

    def receive_datagram(self, datagram: bytes, now: float) -> list[Packet]:
        """Take one datagram of the HQ's source, unless it bears the id of another one."""
        self._sourced = True
        sender_id = _header(datagram)[0]
        if sender_id in (_NO_HEADER[0], self.client_id, *_NOBODYS_IDS):
            return super().receive_datagram(datagram, now)
        self.malformed(f"datagram with id {sender_id}, which is another client's")
        return []

    def accept_datagram(self, message: Packet, now: float) -> bool:
        if not isinstance(message, ClientUDPConnection):
            if self.state is not State.ESTABLISHED:  # whose source this is, only the 7 tells
                raise ProtocolError(f"{type(message).__name__} by UDP before the handshake is over")
            return self.accept(message, now)
        if not self._probe.settle(works=True):
            raise ProtocolError("clientUDPConnection was not due")
        self.transport = "udp"
        self._answer = Datagram(self.encode(ServerUDPConnection(True)))
        self.outbox.put_exempt(self._answer)
        self._report.begin(now)
        return False

    def may_send(self, message: Packet) -> None:
        """Raise Refused for a packet that this HQ does not know."""
        packet_id = message.id if isinstance(message, OpaquePacket) else message.spec.id
        if packet_id not in self.known:
            raise Unsupported(f"an HQ of version {self._agreed} does not know packet {packet_id}")

    def _take_settings(self, message: ClientSettings, now: float) -> None:
        if self.client is not None:
            raise ProtocolError("clientSettings a second time")
        agreed = agree(self._versions, parse_versions(message.versions))
        if agreed is None:
            self.refuse_versions(message.versions, self._versions, now)
            return
        self.client = read_settings(message.versions, message.block, HQ_BLOCKS)
        self._agreed = agreed
        row = newest((agreed,), known=VERSIONS)
        self.known = self._also_known | (VERSIONS[row].known_to_hq if row is not None else frozenset())
        if self.settings.udp and self.client.udp:
            self.lift_limit()
            self.send_first(ServerStartUDP())
            self._probe.begin(now)
            self._heard_until = now + PROBE_S
        else:
            self._finish()

    def _take_report(self, *, works: bool) -> None:
        """End the handshake with packet 7. Programs of 1.3 say true whatever happened, false is the truth, and who
        heard a 6 answers at once: a 7 that comes when waiting for it has ended is of one that heard none.

        An HQ that got no 6 may not be who sent the 5 that was answered; nor one that never says.
        """
        self._probe.settle(works=False)
        self._report.settle(works=works)
        if not works and self._sourced:
            self._sourced, self.transport = False, "tcp"
            self.drops_source = True
        self._finish()

    def _finish(self) -> None:
        assert self.client is not None
        self.establish(self._agreed, tuple(feature.value for feature in self.client.features))

    def timers(self) -> float:
        return min(self._probe.deadline, self._report.deadline)

    def on_timer(self, now: float) -> None:
        if self._probe.expire(now):
            self._report.begin(now)
        if self._report.expire(now):
            self._take_report(works=False)
