"""One robot of the TCP/UDP package protocol, seen from its HQ: commands to packets, and its stop. Sans-IO.

Source: "Translation of commands", "Versions and dialects" (61) and "Limits" of the protocol page. Telemetry is
translated by :mod:`.telemetry`.

Theory of operation of the stop. One slot of the outbox holds what is repeated: the packets of the last drive, or packet
13. Packet 13 does not end mode 3, and no packet acknowledges a mode: a robot that stalls drops what piled up, another
mode included. So once a mode 3 was written, every stop and every neutral is a pair: packet 10, then packet 13. The mode
of the pair is the one that was commanded last, or 1 where that is mode 3 (``_stop_packets``). A mode that is commanded
while a stop is repeated stays in force: mode 3 ends the repetitions, another mode replaces that of the pair.

After a stall, robots of 1.1 and 1.2 drop what piled up, and then ignore the first packet that they read alone. Some
read every 0.1 to 0.2 s only, and join packets that come closer together. So they are sent :data:`IDLE_STOP_S` stops
evenly while nobody drives, and the two packets of a pair at half that distance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, ClassVar

from gateways.tcpudp import messages as packets
from gateways.tcpudp.options import NAME, TcpUdpOptions
from gateways.tcpudp.session import limits
from gateways.tcpudp.session.hq_role import HqRole
from gateways.tcpudp.settings import Feature
from gateways.tcpudp.telemetry import OFF, ON, TelemetryTranslator
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Mode, Raw, Scan, Switch, Text
from zbridge.fleet.topics import Topic
from zbridge.protocol import (
    Malformed,
    Metrics,
    NotReady,
    Outcome,
    Refused,
    RobotSide,
    Telemetry,
    Translate,
    Unsupported,
)

if TYPE_CHECKING:
    import numpy as np

REPEAT_S = 0.25
"""Seconds after which a drive command is repeated while the robot moves."""
STOP_REPEAT_S = 0.1
"""Seconds between the repetitions of a stop: a late datagram can restart motion."""
NEUTRAL_S = 1.0
"""Seconds for which a neutral is repeated."""
IDLE_STOP_S = 0.25
"""Seconds between two stops to robots of 1.1 and 1.2 while nobody drives: after a stall they ignore the first one."""
AUTONOMOUS = "autonomous"
_MODES = {"none": 1, "manual": 2, AUTONOMOUS: 3}
_MOTION = "motion"
_NOTHING = Outcome()


class TcpUdpRobot(RobotSide):
    """One robot of the TCP/UDP package protocol, seen from its HQ."""

    hands_over = True
    driving: HqRole | None = None
    kept: ClassVar[dict[str, Any]] = {
        "_chosen": str | None,
        "_stop_until": float,
        "_telemetry": TelemetryTranslator,
    }

    def __init__(self, options: TcpUdpOptions, links: int = 1, metrics: Metrics | None = None) -> None:
        self.options = options
        self.link_names = ("robot",)
        self._force = tuple(Feature(entry) if isinstance(entry, str) else entry for entry in options.force)
        self._announce = tuple(Feature(name) for name in options.announce)
        self._telemetry = TelemetryTranslator(options)
        self._chosen: str | None = None
        """The mode that was commanded last."""
        self._stop_until = -math.inf
        """How long a stop or a neutral is repeated."""
        self._was_autonomous = False
        """Whether a gateway before this one may have sent mode 3."""

    def session(self, link: str, peer: str) -> HqRole:
        self.driving = HqRole(
            limits(self.options.gap_s),
            udp=self.options.udp,
            force=self._force,
            announce=self._announce,
            predecessor=self.driving,
        )
        self.driving.sent_autonomous = self.driving.sent_autonomous or self._was_autonomous
        self._stop_until = -math.inf
        self._telemetry.begin(self.driving)
        return self.driving

    def translator(self, kind: type) -> Translate:
        return self._telemetry.translator(kind)

    # Commands to packets

    def command(self, topic: Topic, command: FleetMessage, now: float) -> Outcome:
        carry_out = _COMMANDS.get(topic.path)
        if carry_out is None:
            raise Unsupported("a TCP/UDP robot has no such command")
        return carry_out(self, command, now) or _NOTHING

    @property
    def accepts(self) -> tuple[str, ...]:
        session = self.driving
        if session is None:
            return ()
        return tuple(name for name, any_of in _CARRIERS.items() if any(session.knows(each.spec) for each in any_of))

    def stop(self, now: float, until: float) -> None:
        """Send packet 13, or the pair once a mode 3 was sent.

        A stop that is repeated cancels the repetitions of other commands; a single one, which is routine, does not.
        """
        session = self._connected()
        session.withdraw_autonomous()
        session.withdraw_raw()
        if until > now:
            session.send_nothing_again()
        elif session.misreads:
            self._repeat_stop(now, until=until)
            return
        self._repeat_stop(now, period_s=STOP_REPEAT_S, until=until, urgent=True)

    def was_autonomous(self) -> None:
        """Send the pair of packets from the first stop on ("Stops after mode 3")."""
        self._was_autonomous = True
        if self.driving is not None:
            self.driving.sent_autonomous = True

    @property
    def idle_stop_s(self) -> float:
        return IDLE_STOP_S if self.driving is not None and self.driving.misreads else math.inf

    def stop_frames(self) -> tuple[bytes, ...]:
        """Packet 13; the pair also where mode 3 was commanded and is not written yet."""
        session = self._connected()
        return _sendable(session, self._stop_packets(paired=session.sent_autonomous or self._chosen == AUTONOMOUS))

    def begun(self, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Load numpy for a robot with maps or simulated lidar: now, not with the first one while it moves."""
        session = self.driving
        if session is not None and {Feature.SLAM_MAP.value, Feature.LIDAR_SIM.value} & set(session.features):
            import numpy  # noqa: F401
        return ()

    def known(self, topic: Topic) -> FleetMessage | None:
        return self._telemetry.known_map() if topic is topics.MAP else None

    def ask(self, topic: Topic) -> None:
        if topic is not topics.MAP:
            self._send(packets.ClientGetPosition())
            return
        if not self._telemetry.sends_parts:
            self._send(packets.ClientGetSLAMMap())
        self._telemetry.await_map()

    def _drive(self, command: Drive, now: float) -> Outcome:
        left_out = "light: a TCP/UDP robot has none" if command.light is not None else None
        session, translation = self._connected(), math.hypot(command.forward, command.left)
        if not (translation or command.turn):
            session.withdraw_autonomous()
            self._neutral(session, now)
            return Outcome(left_out=left_out)
        moves: list[packets.Packet] = []
        if translation:
            speed = min(1.0, translation) * self.options.speed_full
            moves.append(
                packets.ClientJoystickMove((0.0 - command.left) / translation, command.forward / translation, speed)
            )
        if command.turn:
            moves.append(packets.ClientJoystickRotate(-command.turn * self.options.turn_full))
        if len(moves) == 2 and self.options.combine == "exclusive":
            rotates = abs(command.turn) > translation
            moves = moves[1:] if rotates else moves[:1]
            left_out = f"{'forward and left' if rotates else 'turn'}: options.combine = 'exclusive'"
        frames = tuple(session.encode(packet) for packet in moves)
        session.outbox.set(_MOTION, frames, now, period_s=REPEAT_S)
        self._stop_until = -math.inf
        return Outcome(left_out=left_out) if left_out else _NOTHING

    def _neutral(self, session: HqRole, now: float) -> None:
        """Repeat neutral for a second. If it is already repeated, keep its times: programs send it all the time."""
        until = now + NEUTRAL_S
        frames = _sendable(session, self._stop_packets(paired=session.sent_autonomous))
        if session.outbox.prolong(_MOTION, frames, period_s=REPEAT_S, until=until):
            self._stop_until = max(self._stop_until, until)
        else:
            self._repeat_stop(now, period_s=REPEAT_S, until=until, urgent=session.sent_autonomous)

    def _mode(self, command: Mode, now: float) -> None:
        """Send the mode. While a stop is repeated: mode 3 ends it, any other mode replaces that of the pair."""
        session = self._connected()
        session.choose_mode(_MODES[command.mode], now)
        self._chosen = command.mode
        if now >= self._stop_until:
            return
        if command.mode == AUTONOMOUS:
            session.outbox.clear(_MOTION)
        elif session.sent_autonomous:
            self._repeat_stop(now, period_s=STOP_REPEAT_S, until=self._stop_until)

    def _switch_lidar(self, command: Switch, now: float) -> None:
        self._connected().switch_lidar(ON if command.on else OFF, now)

    def _switch_camera(self, command: Switch, now: float) -> None:
        raise Unsupported("no packet turns a camera on or off")

    def _send_text(self, command: Text, now: float) -> None:
        if command.kind != "debug":
            raise Unsupported(f"text of kind {command.kind!r}: only 'debug' has a packet; chat is opaque, send it raw")
        self._send(packets.DebugMessage(command.text))

    def _send_scan(self, command: Scan, now: float) -> Outcome:
        self._send(packets.ClientSimulatedLidarData(polar_ranges(command, self.options.length_unit_m)))
        return Outcome(telemetry=((topics.SCAN, command),))

    def _send_raw(self, command: Raw, now: float) -> None:
        self._connected().send_raw(_raw_packet(command))

    def _send(self, message: packets.Packet) -> None:
        self._connected().send(message)

    def _repeat_stop(self, now: float, *, until: float, period_s: float = math.inf, urgent: bool = False) -> None:
        """Repeat the packets of a stop; raise Refused if the robot may be sent none of them."""
        session, spacing_s = self._connected(), 0.0
        frames = _sendable(session, self._stop_packets(paired=session.sent_autonomous))
        if session.misreads and len(frames) > 1:  # each of the pair must be read alone
            spacing_s = IDLE_STOP_S / 2
            period_s = max(period_s, spacing_s)
        session.outbox.set(_MOTION, frames, now, period_s=period_s, until=until, spacing_s=spacing_s, urgent=urgent)
        self._stop_until = until

    def _stop_packets(self, *, paired: bool) -> tuple[packets.Packet, ...]:
        """Packet 13; ``paired``: after a mode that ends mode 3, the one that the holder wants or none."""
        mode = _MODES["manual" if self._chosen == "manual" else "none"]
        stop = packets.ClientJoystickStop()
        return (packets.ClientControllMode(mode), stop) if paired else (stop,)

    def _connected(self) -> HqRole:
        if self.driving is None:
            raise NotReady("offline")
        return self.driving


def _sendable(session: HqRole, wanted: Iterable[packets.Packet]) -> tuple[bytes, ...]:
    """Write the packets that the robot may be sent; raise Refused if it may be sent none of them."""
    frames, refusal = [], None
    for packet in wanted:
        try:
            frames.append(session.encode(packet))
        except Refused as refused:
            refusal = refused
    if refusal is not None and not frames:
        raise refusal
    return tuple(frames)


def _raw_packet(command: Raw) -> packets.Packet:
    """Make the packet of a raw command; raise Refused if a fleet message holds that packet."""
    spec = packets.PACKETS.get(command.id)
    if spec is None:
        if not 0 <= command.id <= 255:
            raise Malformed(f"packet id {command.id}, expected 0 to 255")
        return packets.OpaquePacket(command.id, command.body)
    if spec.packet is packets.ClientMoveAI:
        return packets.ClientMoveAI(command.body)
    if spec.packet is packets.ChatMessage:
        return packets.ChatMessage(command.body)
    raise Unsupported(f"{spec.name} ({spec.id}) is not raw: use the command or query that holds it")


_COMMANDS: dict[str, Callable[[TcpUdpRobot, Any, float], Outcome | None]] = {
    topics.CMD_DRIVE.path: TcpUdpRobot._drive,
    topics.CMD_MODE.path: TcpUdpRobot._mode,
    topics.CMD_LIDAR.path: TcpUdpRobot._switch_lidar,
    topics.CMD_CAMERA.path: TcpUdpRobot._switch_camera,
    topics.CMD_TEXT.path: TcpUdpRobot._send_text,
    topics.CMD_SCAN.path: TcpUdpRobot._send_scan,
    topics.CMD_RAW(NAME).path: TcpUdpRobot._send_raw,
}


_CARRIERS: dict[str, tuple[type[packets.Packet], ...]] = {
    "drive": (packets.ClientJoystickMove,),
    "mode": (packets.ClientControllMode,),
    "lidar": (packets.ClientLidarMode,),
    "text": (packets.DebugMessage,),
    "scan": (packets.ClientSimulatedLidarData,),
    "raw": (packets.ChatMessage, packets.ClientMoveAI),
}
"""The commands that some packet carries, and the packets, one of which is enough."""

SCAN_POINTS = 360
"""Points legacy robots take in simulated lidar data, one a degree."""


def polar_ranges(scan: Scan, unit_m: float) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Resample a scan to float32[360] in the robot's unit, index = degree counter-clockwise from straight ahead.

    Each degree takes the nearest point of the scan, 0 where the scan has none or it is invalid or out of range.
    """
    import numpy as np

    count = len(scan.ranges)
    polar = np.zeros(SCAN_POINTS, np.float32)
    if count == 0 or not scan.angle_increment or not math.isfinite(scan.angle_increment + scan.angle_min):
        return polar
    step = abs(scan.angle_increment)
    circle = 2 * math.pi / step
    with np.errstate(all="ignore"):  # a point with an absurd number counts as not measured
        offsets = np.radians(np.arange(SCAN_POINTS)) - scan.angle_min
        nearest = np.rint(np.mod(math.copysign(1.0, scan.angle_increment) * offsets, 2 * math.pi) / step)
        nearest = np.where(nearest >= circle - 0.5, 0.0, nearest)  # after the last point comes the first
        covered = nearest < count
        values = np.asarray(scan.ranges, np.float32)[nearest[covered].astype(np.int64)]
        usable = np.isfinite(values) & (values >= scan.range_min) & (values <= scan.range_max)
        lengths = values / np.float32(unit_m)
        polar[covered] = np.where(usable & np.isfinite(lengths), lengths, 0)
    return polar
