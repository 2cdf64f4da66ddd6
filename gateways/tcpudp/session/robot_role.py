"""The gateway plays the robot towards one HQ program, and decides whose datagrams are that program's. Sans-IO.

Source: "The handshake with an HQ program", "Whose datagrams count", "Versions and dialects" and
"Towards HQ programs" of the protocol page.

Theory of operation. The handshake is the table at the foot of this file: :class:`RobotStep` says what the session waits
for, :class:`RobotEvent` what can happen, and every row names the action that is taken. The session is ``established``
from the steps STREAM and DONE on. Datagrams are claimed in the steps PROBED, ANSWERED and DONE only. The client's 7
never makes a source: 7(false) is reliable, 7(true) is not, as programs of 1.3 always send it. A program that gets a 6
sends its 7 at once. So a 7 later than :data:`PROBE_S` after the 4 shows that the program got no 6: the 5 may have been
somebody else's, and the source is dropped.

Any process of the HQ program's host can send datagrams, and only their source identifies them. A port becomes the
client's source in two ways only:

- by a 5 between our 4 and its 7 (:meth:`ClientSource.claims_probe`). If a second port sends a 5 too, the session
  accepts datagrams of neither;
- after the handshake, while the client has no source, by a packet with its id from the port that legacy programs bind
  (:meth:`ClientSource.claims_late`): a program of 1.3 whose 5 was lost sends 11, 12 and 61 by UDP all the same. If it
  has another source then, one of the two is not the client, and the session no longer accepts datagrams of either.

The session sets :attr:`ClientSource.bound` with the first datagram that it is given, and calls
:meth:`ClientSource.lose` when a rival shows up.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from enum import Enum
from typing import Any, ClassVar

from gateways.tcpudp import messages as packets
from gateways.tcpudp.session import Decode, PacketSession, decoders, id_of
from gateways.tcpudp.settings import HQ_BLOCKS, LISTED, SETTINGS, VERSIONS, Settings, read_settings
from zbridge.protocol import (
    FRAME,
    Datagram,
    Exported,
    Handshake,
    Kept,
    Limits,
    NotReady,
    ProtocolError,
    Role,
    SourceClaims,
    State,
    Unsupported,
    agree,
    newest,
    parse_versions,
)

CLIENT_PORT = 11000
"""The UDP port that legacy HQ programs bind."""
FROM_HQ: dict[int, Decode] = decoders(Role.ROBOT)
"""How to read what an HQ program may send, by packet id."""
_UNASSIGNED = (0, packets.SERVER_ID)
"""The ``id`` bytes that no client is given."""
_PROBE = packets.ClientUDPConnection.spec.id


class ClientSource(Kept):
    """The source of one client's datagrams. ``client_port``: the UDP port that it is known to bind; 0: none."""

    kept: ClassVar[dict[str, Any]] = {"bound": bool, "_port": int, "_contested": bool}

    def __init__(self, client_id: int, client_port: int) -> None:
        self.client_port = client_port
        self.bound = False
        """True while datagrams come from a port that counts as the client's: that of the last claim."""
        self._client_id = client_id
        self._port = 0
        self._contested = False
        """True once two ports claimed to be the client's after the handshake."""

    def __repr__(self) -> str:
        return f"<ClientSource of {self._client_id}: {self._port if self.bound else 'none'}>"

    def claims_probe(self, datagram: bytes, port: int) -> bool:
        """Claim a 5 with the client's id or an unassigned one."""
        sender_id, packet_id = _header(datagram)
        own = sender_id == self._client_id or sender_id in _UNASSIGNED
        return self._claim(port) if own and packet_id == _PROBE else False

    def claims_late(self, datagram: bytes, port: int) -> bool:
        """Claim a packet with the client's id from its port, unless that is its source or was contested."""
        if port != self.client_port or self._contested or (self.bound and self._port == port):
            return False
        sender_id, packet_id = _header(datagram)
        return self._claim(port) if sender_id == self._client_id and packet_id in FROM_HQ else False

    def lose(self, *, for_good: bool = False) -> None:
        """Have no source; ``for_good``: let none be claimed late."""
        self.bound = False
        self._contested = self._contested or for_good

    def _claim(self, port: int) -> bool:
        if not self.bound:
            self._port = port
        return True


def _header(datagram: bytes) -> tuple[int, int]:
    """Return the ``id`` byte and the packet id of a datagram; -1 each, which decoding refuses, if it is no packet."""
    try:
        return packets.read_header(datagram)
    except ProtocolError:
        return -1, -1


PROBE_S = 2.0
"""Seconds an HQ program has for its datagram 5."""
REPORT_S = 3.0
"""Seconds it has for packet 7: it may wait 2 s for a 6 that was lost."""
RIVAL = "another source of datagrams claims to be this client"
_HEADER_SIZE = packets.HEADER.size
_HANDSHAKING, _ESTABLISHED = State.HANDSHAKING, State.ESTABLISHED
"""As plain names: every client of a host is asked about every datagram that has no owner yet."""


class RobotStep(Enum):
    """What the handshake waits for."""

    GREETED = "sent 2, waits for 3"
    PROBED = "sent 4, waits for 5"
    ANSWERED = "got 5 and sent 6, waits for 7"
    UNANSWERED = "sent no 6, waits for 7"
    STREAM = "established; no 4 was sent"
    DONE = "established after a 4"


class RobotEvent(Enum):
    """What can happen in a handshake."""

    SETTINGS_UDP = "3, and both set the UDP flag"
    SETTINGS_TCP = "3, and not both set the UDP flag"
    PROBE = "5 by UDP from the source"
    REPORT_TRUE = "7(true) within 2 s of the 4"
    REPORT_FALSE = "7(false), or later"
    RIVAL = "a second source sends a 5"
    TIMEOUT = "the step lasts too long"


class RobotRole(PacketSession, SourceClaims):
    """One conversation with an HQ program.

    ``settings``: announced; ``block``: the settings block as sent, default that of ``settings``; ``client_id``: given
    to the HQ; ``versions``: listed verbatim; ``known``: packet ids that the HQ knows besides those of its version;
    ``client_port``: the UDP port that it is known to bind, 0 for none. The ``id`` byte of what it sends by TCP is
    ignored: the connection identifies it, and programs send 0 before they have read the settings.
    """

    kept: ClassVar[dict[str, Any]] = {
        "settings": SETTINGS,
        "client": SETTINGS,
        "known": frozenset[int],
        "_block": bytes,
        "_agreed": str,
        "_source": ClientSource,
        "_answer": FRAME,
        "_report_until": float,
        "_handshake": Handshake,
    }
    role = Role.ROBOT
    handled = frozenset({packets.ClientSettings, packets.ClientUDPConnection, packets.ClientUDPConnectionStatus})
    sender_id = packets.SERVER_ID

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
        """What the HQ announced."""
        self.known: frozenset[int] = frozenset()
        """The packet ids that the HQ knows; one it does not know cripples it for good."""
        self._block = settings.encode() if block is None else block
        self._also_known = frozenset(known)
        self._versions = tuple(versions)
        self._agreed = ""
        self._source = ClientSource(client_id, client_port)
        self._answer: bytes | None = None
        """Packet 6, once it was queued."""
        self._report_until = -math.inf
        """Until when a 7(true) answers a 6 that was received."""
        within_s = {RobotStep.PROBED: PROBE_S, RobotStep.ANSWERED: REPORT_S, RobotStep.UNANSWERED: REPORT_S}
        self._handshake = Handshake(self, TABLE, RobotStep.GREETED, timeout=RobotEvent.TIMEOUT, within_s=within_s)

    def restore(self, state: Exported) -> None:
        super().restore(state)
        self._answer = self.outbox.found(self._answer)

    def decode(self, frame: bytes) -> packets.Packet:
        decode = FROM_HQ.get(frame[5])
        if decode is None:
            raise self.misplaced(frame)
        return decode(frame, _HEADER_SIZE)

    def may_send(self, message: packets.Packet) -> None:
        """Raise Unsupported for a packet that this HQ does not know."""
        if id_of(message) not in self.known:
            raise Unsupported(f"an HQ of version {self._agreed} does not know packet {id_of(message)}")

    # The stream

    def opened(self, now: float) -> None:
        self.send_first(packets.ServerSettings(self.client_id, ",".join(self._versions), self._block))

    def accept(self, message: packets.Packet, now: float) -> bool:
        if isinstance(message, packets.ClientSettings):
            self._take_settings(message, now)
        elif self.client is None:
            raise ProtocolError(f"{type(message).__name__} before clientSettings")
        elif isinstance(message, packets.ClientUDPConnectionStatus):
            confirmed = message.connected and now < self._report_until
            self._fire(RobotEvent.REPORT_TRUE if confirmed else RobotEvent.REPORT_FALSE, message, now)
        elif isinstance(message, packets.ClientUDPConnection):
            raise ProtocolError("clientUDPConnection by TCP")
        else:
            return True
        return False

    def _take_settings(self, message: packets.ClientSettings, now: float) -> None:
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
        udp = self.settings.udp and self.client.udp
        self._fire(RobotEvent.SETTINGS_UDP if udp else RobotEvent.SETTINGS_TCP, message, now)

    # Datagrams

    def claims(self, datagram: bytes, port: int) -> bool:
        """Claim a 5 between our 4 and its 7; later a packet with the client's id from its port."""
        step = self._handshake.step
        if self.state is _ESTABLISHED:
            return step is RobotStep.DONE and self._source.claims_late(datagram, port)
        probed = self.state is _HANDSHAKING and (step is RobotStep.PROBED or step is RobotStep.ANSWERED)
        return probed and self._source.claims_probe(datagram, port)

    def rivalled(self, now: float) -> None:
        """Take datagrams of neither source; in the handshake see :meth:`_reject_both`."""
        self.left_out[RIVAL] += 1
        established = self.state is State.ESTABLISHED
        self._source.lose(for_good=established)
        self.transport = "tcp"
        if not established:
            self._handshake.fire(RobotEvent.RIVAL, now)

    def stray(self, datagram: bytes) -> None:
        """Count a datagram with this client's id from an unknown port; raise NotReady with a text for the client."""
        if self.state is State.ESTABLISHED and _header(datagram)[0] == self.client_id:
            self.traffic.foreign += 1
            text = "packets by UDP from another port than this client's are not taken"
            raise NotReady(f"{text} (client_port = {self._source.client_port})")

    def receive_datagram(self, datagram: bytes, now: float) -> list[packets.Packet]:
        """Take one datagram of the client's source, unless it has the id of another client."""
        self._source.bound = True
        sender_id, _ = _header(datagram)
        if sender_id in (-1, self.client_id, *_UNASSIGNED):
            return super().receive_datagram(datagram, now)
        self.malformed(f"datagram with id {sender_id}, which is another client's")
        return []

    def accept_datagram(self, message: packets.Packet, now: float) -> bool:
        if isinstance(message, packets.ClientUDPConnection):
            self._fire(RobotEvent.PROBE, message, now)
            return False
        if self.state is not State.ESTABLISHED:  # until the 7 the source may be somebody else's
            raise ProtocolError(f"{type(message).__name__} by UDP before the handshake is over")
        return self.accept(message, now)

    # Timers

    def timers(self) -> float:
        return self._handshake.deadline

    def on_timer(self, now: float) -> None:
        self._handshake.expire(now)

    # Actions of the table

    def _fire(self, event: RobotEvent, message: packets.Packet, now: float) -> None:
        """Take a message of the handshake; raise ProtocolError if it is not due."""
        if not self._handshake.fire(event, now):
            raise ProtocolError(f"{message.spec.name} was not due")

    def _offer_udp(self, now: float) -> None:
        """Send 4; the time limit of the settings ends."""
        self.lift_limit()
        self.send_first(packets.ServerStartUDP())
        self._report_until = now + PROBE_S

    def _answer_probe(self, now: float) -> None:
        """Send 6(true) by UDP to the source of the 5."""
        self.transport = "udp"
        self._answer = Datagram(self.encode(packets.ServerUDPConnection(True)))
        self.outbox.put_exempt(self._answer)

    def _send_no_answer(self, now: float) -> None:
        """Send no 6: any 6, false too, makes programs of 1.1 and 1.2 believe in UDP."""

    def _reject_both(self, now: float) -> None:
        """Take the 6 back; close if it has left: the program believes in UDP then."""
        answer, self._answer = self._answer, None
        if answer is not None and not self.outbox.withdraw(answer):
            self.close(RIVAL, now)

    def _drop_source(self, now: float) -> None:
        """Drop the source; establish the session without UDP."""
        if self._source.bound:
            self._source.lose()
            self.transport = "tcp"
            self.drops_source = True
        self._finish(now)

    def _finish(self, now: float) -> None:
        """Establish the session."""
        assert self.client is not None
        self.establish(self._agreed, tuple(feature.value for feature in self.client.features))


TABLE: dict[RobotStep, dict[RobotEvent, tuple[Callable[[RobotRole, float], None], RobotStep]]] = {
    RobotStep.GREETED: {
        RobotEvent.SETTINGS_UDP: (RobotRole._offer_udp, RobotStep.PROBED),
        RobotEvent.SETTINGS_TCP: (RobotRole._finish, RobotStep.STREAM),
    },
    RobotStep.PROBED: {
        RobotEvent.PROBE: (RobotRole._answer_probe, RobotStep.ANSWERED),
        RobotEvent.TIMEOUT: (RobotRole._send_no_answer, RobotStep.UNANSWERED),
        RobotEvent.RIVAL: (RobotRole._send_no_answer, RobotStep.UNANSWERED),
        RobotEvent.REPORT_TRUE: (RobotRole._finish, RobotStep.DONE),
        RobotEvent.REPORT_FALSE: (RobotRole._drop_source, RobotStep.DONE),
    },
    RobotStep.ANSWERED: {
        RobotEvent.RIVAL: (RobotRole._reject_both, RobotStep.UNANSWERED),
        RobotEvent.REPORT_TRUE: (RobotRole._finish, RobotStep.DONE),
        RobotEvent.REPORT_FALSE: (RobotRole._drop_source, RobotStep.DONE),
        RobotEvent.TIMEOUT: (RobotRole._drop_source, RobotStep.DONE),
    },
    RobotStep.UNANSWERED: {
        RobotEvent.RIVAL: (RobotRole._send_no_answer, RobotStep.UNANSWERED),
        RobotEvent.REPORT_TRUE: (RobotRole._finish, RobotStep.DONE),
        RobotEvent.REPORT_FALSE: (RobotRole._drop_source, RobotStep.DONE),
        RobotEvent.TIMEOUT: (RobotRole._drop_source, RobotStep.DONE),
    },
    RobotStep.STREAM: {},
    RobotStep.DONE: {},
}
