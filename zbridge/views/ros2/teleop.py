"""Lets publishers on a robot's cmd_vel drive it, one at a time, through the lease.

Theory of operation. A liveliness watch knows the publishers by their tokens, and :mod:`driving` what each may do.
Zenoh loses the news of some tokens while many come and go at once: they are asked for again, at most every
:data:`ASK_S`, where somebody unknown commands or there is no place for another publisher.
:meth:`Teleop._sort` runs on Zenoh's threads: it drops what no known publisher sent, and what comes faster than
:data:`RATE_HZ`, before the event loop receives it. The rest is read (``cmd_vel``), and carried out by the publisher's
pilot.
"""

from __future__ import annotations

import asyncio
import math
from functools import partial

from zbridge.bus import Bus, Handle, PriorityClass, ReadPayload, Sample
from zbridge.client import Robot
from zbridge.client.pilot import Pilot
from zbridge.errors import BusError, Malformed, PayloadError, ProtocolError, Refused, Unsupported
from zbridge.fleet import payload as payloads
from zbridge.fleet.messages import Control, Drive
from zbridge.lease.stick import Stick
from zbridge.protocol.rate_limit import RateLimit
from zbridge.ros2.rmw_zenoh import KEEP_LAST_10, Endpoint, Kind, Node, endpoints_of, read_attachment, read_token
from zbridge.views.ros2.cmd_vel import MOST_BYTES, read_twist
from zbridge.views.ros2.diagnostics import MOST_VALUES, OK, WARN, Diagnostic, cut
from zbridge.views.ros2.driving import DEADMAN_S, PUBLISHERS, QUIET_S, RULES, Driving
from zbridge.views.ros2.outlets import RosSide
from zbridge.views.ros2.settings import RobotBody

NAME = "ros2"
"""The first part of a driver's name where no certificate says another; the publisher's node follows."""
WAIT_S = 2.0
"""Longest wait for the robot's gateway."""
RATE_HZ = 200.0
"""Commands a second of one publisher that are heard."""
STRANGERS_HZ = 5.0
"""Commands a second of publishers without a token that are counted as refused one by one."""
SETTLE_S = 1.0
"""Tokens that come within this time of a connection were there before."""
ASK_S = 2.0
"""Least time between two questions for the publishers' tokens."""
WRONG_TYPES = 16
"""Publishers of a type that is no Twist, or of another version of it, that are shown."""
_ATTACHED_BYTES = 33
_GID = slice(17, 33)


class Teleop:
    """The cmd_vel of one robot. fleet: the fleet's bus; control_key: where the robot's control is told there.

    name: the first part of the name that drivers are given.
    """

    def __init__(
        self, side: RosSide, node: Node, robot: Robot, body: RobotBody, fleet: Bus, control_key: str, name: str
    ) -> None:
        self._side = side
        self._robot = robot
        self._body = body
        self._loop = asyncio.get_running_loop()
        self._driving = Driving(robot.name)
        self._name = name
        self._pilots: dict[bytes, Pilot] = {}
        """By the gids of the publishers that are known."""
        self._turn = asyncio.Lock()
        self._fleet = fleet
        self._control_key = control_key
        self._control: Handle | None = None
        self._stopped: bool | None = None
        self._limits: dict[bytes, RateLimit] = {}
        """By the gids of publishers that have a token."""
        self._known: dict[bytes, bytes] = {}
        """By each gid that such a publisher may send with, the one it is known by."""
        self._strangers = RateLimit(STRANGERS_HZ)
        self._tokens: dict[str, bytes] = {}
        """The gids of the publishers that are known, by their tokens."""
        self._asked_at = -math.inf
        self._asking: asyncio.Task[None] | None = None
        self._left: set[str] = set()
        """Tokens that went while the answer was on its way."""
        self._wrong: dict[str, str] = {}
        """By the tokens of publishers of another type, what they are."""
        self._counts = {name: side.metrics.count(f"ros2_cmd_vel_{name}") for name in _COUNTS}
        self._settled_at = self._loop.time() + SETTLE_S
        self.topic = f"{node.namespace}/cmd_vel"
        self._publishers = endpoints_of(side.domain, Kind.PUBLISHER, self.topic)
        self._handles = self._declare(node)

    def __repr__(self) -> str:
        return f"<Teleop {self.topic}, {self._driving!r}>"

    def _declare(self, node: Node) -> list[Handle]:
        bus, handles = self._side.bus, list[Handle]()
        for type_name in MOST_BYTES:
            endpoint = self._side.endpoint(node, Kind.SUBSCRIBER, self.topic, type_name, KEEP_LAST_10)
            sort = partial(self._sort, MOST_BYTES[type_name])
            handles.append(bus.subscribe(endpoint.key, partial(self._take, type_name), priority=sort))
            handles.append(bus.announce(endpoint.token()))
        handles.append(bus.watch_alive(self._publishers, self._on_token))
        return handles

    async def close(self) -> None:
        """Give the robot back, and take everything back that was declared; idempotent."""
        handles, self._handles = self._handles, []
        for handle in handles:
            handle.close()
        self._watch_control(False)
        if self._asking is not None:
            self._asking.cancel()
        for pilot in self._pilots.values():
            pilot.release()
        async with self._turn:  # publishers that are gone may still release the robot
            pass

    # Who is there

    def connected(self, up: bool) -> None:
        """ROS's router was found again, or lost: then nobody is there."""
        self._settled_at = self._loop.time() + SETTLE_S
        if not up:
            if self._asking is not None:  # its answer may be from before
                self._asking.cancel()
                self._asking = None
            for token in list(self._tokens):
                self._forget(token)

    def _on_token(self, token: str, alive: bool, *, late: bool = False) -> None:
        """Enter a publisher, or forget it. late: it existed before, and we did not know."""
        if not alive and self._asking is not None:
            self._left.add(token)
        endpoint = read_token(token)
        if not isinstance(endpoint, Endpoint) or endpoint.kind is not Kind.PUBLISHER:
            self._counts["tokens_unreadable"].value += 1
            return
        if not self._is_twist(endpoint):
            self._note_wrong(token, endpoint, alive)
            return
        gid, now = endpoint.gid(), self._loop.time()
        if not alive:
            self._forget(token)
        elif self._driving.came(gid, endpoint.node.full_name, now, early=late or now < self._settled_at):
            self._tokens[token] = gid
            if gid not in self._pilots:
                self._pilots[gid], self._limits[gid] = self._pilot(gid), RateLimit(RATE_HZ)
            self._known.update(dict.fromkeys(endpoint.gids(), gid))
        else:
            self._counts["publishers_refused"].value += 1
            self._ask()
        self._watch_control(bool(self._driving.publishers))

    def _is_twist(self, endpoint: Endpoint) -> bool:
        name = endpoint.type_name
        return name in MOST_BYTES and endpoint.type_hash == self._side.types.hash(name)

    def _note_wrong(self, token: str, endpoint: Endpoint, alive: bool) -> None:
        if not alive:
            self._wrong.pop(token, None)
        else:
            self._counts["wrong_type"].value += 1
            if len(self._wrong) < WRONG_TYPES:
                self._wrong[token] = f"{endpoint.node.full_name} publishes {endpoint.type_name} {endpoint.type_hash}"

    def _forget(self, token: str) -> None:
        gid = self._tokens.pop(token, None)
        if gid is None:
            return
        self._known = {also: known for also, known in self._known.items() if known != gid}
        self._limits.pop(gid, None)
        self._driving.gone(gid)
        if (pilot := self._pilots.pop(gid, None)) is not None:
            pilot.release()

    def _pilot(self, gid: bytes) -> Pilot:
        """Make the pilot of a publisher: one after the other may ask for the robot."""
        publisher = self._driving.publishers[gid]
        who = f"{self._name}.{publisher.name.strip('/')}"
        control = partial(self._robot.control, who, name=self._name, deadman_s=DEADMAN_S, wait_s=WAIT_S)
        return Pilot(publisher.stick, control, turn=self._turn)

    def _ask(self) -> None:
        """Ask who is there, now and then."""
        now = self._loop.time()
        if self._asking is None and now - self._asked_at >= ASK_S and self._handles:
            self._asked_at = now
            self._left.clear()
            self._asking = self._loop.create_task(self._look())

    async def _look(self) -> None:
        """Forget the publishers that have gone, were they not heard lately; enter those that we were not told of."""
        known, asked_at = set(self._tokens), self._asked_at
        try:
            alive = set(await self._side.bus.alive(self._publishers))
        except BusError:
            return
        finally:
            if self._asking is asyncio.current_task():
                self._asking = None
        heard_at = {gid: publisher.stick.heard_at for gid, publisher in self._driving.publishers.items()}
        for token in known - alive:
            if heard_at.get(self._tokens.get(token, b""), math.inf) < asked_at - QUIET_S:
                self._on_token(token, False)
        for token in alive - self._tokens.keys() - self._left:
            endpoint = read_token(token)
            if isinstance(endpoint, Endpoint) and self._is_twist(endpoint) and len(self._tokens) < PUBLISHERS:
                self._on_token(token, True, late=True)

    def _watch_control(self, wanted: bool) -> None:
        """Watch who stops the robot, while there is a publisher."""
        if wanted and self._control is None:
            self._stopped = None
            self._control = self._fleet.subscribe(self._control_key, self._on_control)
        elif not wanted and self._control is not None:
            self._control.close()
            self._control = None

    def _on_control(self, sample: Sample) -> None:
        try:
            stopped = payloads.decode(Control, sample.payload).state in ("stopped", "latched")
        except PayloadError:
            return
        if stopped and self._stopped is False:
            self.stopped("the robot was stopped")
        self._stopped = stopped

    def stopped(self, why: str) -> None:
        """The robot was stopped: whoever commands motion now meant it before."""
        for pilot in self._pilots.values():
            pilot.require_neutral(why)
            pilot.release()

    # What they command

    def _sort(
        self, most_bytes: int, key: str, attachment: bytes | None, size: int, read_payload: ReadPayload
    ) -> PriorityClass | None:
        """Choose the priority; on Zenoh's threads."""
        if attachment is None or len(attachment) != _ATTACHED_BYTES or size > most_bytes + _ATTACHED_BYTES:
            self._counts["malformed"].value += 1
            return None
        gid = self._known.get(attachment[_GID], b"")
        limit = self._limits.get(gid)
        now = self._loop.time()
        if limit is None:
            self._counts["strangers"].value += 1
            return PriorityClass.OTHER if self._strangers.take(now) else None
        if not limit.take(now):
            self._counts["too_fast"].value += 1
            return None
        driver = self._driving.driver
        drives = driver is not None and driver is self._driving.publishers.get(gid)
        return PriorityClass.COMMAND if drives else PriorityClass.OTHER

    def _take(self, type_name: str, sample: Sample) -> None:
        if not self._handles:  # it waited to be taken until nothing may be driven any more
            return
        drive, wrong = Drive(), ""
        try:
            attachment = read_attachment(sample.attachment)
            drive = read_twist(self._side.types, type_name, sample.payload, self._body)
        except Unsupported as error:
            wrong = str(error)
        except (ProtocolError, Malformed):
            self._counts["malformed"].value += 1
            return
        gid = self._known.get(attachment.gid, attachment.gid)
        if gid not in self._limits:
            self._ask()
        pilot = self._pilots.get(gid)
        try:
            self._driving.heard(gid, drive.moving, self._loop.time(), wrong)
            if pilot is not None:
                pilot.drive(drive)
        except Refused:
            if pilot is not None and pilot.stick.active:
                pilot.release()
            else:
                self._counts["refused"].value += 1

    # What is told

    def diagnostics(self) -> Diagnostic:
        """Return who drives, and why others may not."""
        publishers = list(self._driving.publishers.values())[:MOST_VALUES]
        values = [(cut(publisher.name), _standing(publisher.stick)) for publisher in publishers]
        values += [("refused", cut(wrong)) for wrong in self._wrong.values()]
        values += [(name, str(count.value)) for name, count in self._counts.items() if count.value]
        driver = self._driving.driver
        refused = [publisher for publisher in publishers if publisher.stick.needs_neutral is not None]
        text = f"driven by {driver.name}" if driver is not None else "nobody drives"
        if refused:
            text += f"; {refused[0].name} is refused: {_standing(refused[0].stick)}"
        level = WARN if refused or self._wrong else OK
        return Diagnostic(level, f"{self._robot.name}: cmd_vel", cut(text), values[:MOST_VALUES])


def _standing(stick: Stick) -> str:
    if stick.needs_neutral is None:
        return "drives" if stick.active else "may drive"
    return cut(f"{stick.needs_neutral}{RULES.advice}")


_COUNTS = ("refused", "malformed", "strangers", "too_fast", "wrong_type", "tokens_unreadable", "publishers_refused")
