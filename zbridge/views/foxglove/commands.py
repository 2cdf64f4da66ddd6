"""What viewers may tell robots: topics they publish on, services they call, parameters they set.

| topic | service | parameter | does |
|---|---|---|---|
| `/r1/cmd_vel` (`geometry_msgs/Twist`) | | | drives, through the lease |
| `/r1/stop` (any message) | `/r1/stop`, `/stop` | `r1.stop` = true | stops the robot, or all; open to every viewer |
| | `/r1/latch`, `/latch` `{"reason": "..."}` | | the same, and nobody drives before the release; open to every viewer |
| | `/r1/unlatch`, `/unlatch` | | releases the stops of the robot, or of the whole fleet |
| | `/r1/light`, `/r1/lidar`, `/r1/camera` `{"on": true}` | `r1.light`, `r1.lidar`, `r1.camera` | switches |
| | `/r1/mode` `{"mode": "manual"}` | `r1.mode` | who moves the robot: holds the lease until it is ``none`` |

All but stops and latches need a viewer that may drive.
"""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Mapping
from functools import partial
from typing import Any

import msgspec

from zbridge.client import Fleet
from zbridge.client.pilot import Pilot
from zbridge.client.stops import Outcome
from zbridge.errors import Held, Malformed, Unsupported, ZbridgeError
from zbridge.fleet.topics import is_name
from zbridge.lease.stick import Stick, StickRules
from zbridge.tasks import Tasks
from zbridge.views.foxglove import replies
from zbridge.views.foxglove.hub import Hub, Subscriber
from zbridge.views.foxglove.replies import Service
from zbridge.views.foxglove.requests import ClientChannel, Scale, read_twist
from zbridge.views.foxglove.source import ViewerCommands

DEADMAN_S = 0.5
"""The gateway stops a robot whose viewer's Twists stay away so long, should this process be gone or stand still."""
PAUSE_S = 0.4
"""Silence after which a robot is stopped and released: before the deadman, so that the next Twist may be motion."""
QUIET_S = 1.0
"""Silence after which a viewer may move a robot again that was taken from it."""
WAIT_S = 2.0
"""Longest wait for the robot's gateway."""
RULES = StickRules(
    keeps=False,
    idle_s=PAUSE_S,
    neutral_counts=True,
    quiet_s=QUIET_S,
    advice="; release the control for a second, then drive",
)
CMD_VEL, STOP, LATCH, UNLATCH = "cmd_vel", "stop", "latch", "unlatch"
_TWISTS = ("geometry_msgs/Twist", "geometry_msgs/msg/Twist")
_SWITCHES = ("light", "lidar", "camera")
_OF_ALL = (STOP, LATCH, UNLATCH)
"""What is called for one robot, and for all."""
_MODES = ("none", "manual", "autonomous")
_UNTOUCHED: Mapping[str, Any] = {"light": False, "lidar": False, "camera": False, "mode": "none", STOP: False}
"""A robot's parameters before anything is known of them."""


class RobotCommands(ViewerCommands):
    """Carries out what viewers tell the robots of a fleet.

    scales: of robots by name, and of all others by ``""``. who: what drivers are called first.
    """

    def __init__(self, hub: Hub, fleet: Fleet, scales: Mapping[str, Scale], who: str) -> None:
        self._hub = hub
        self._fleet = fleet
        self._scales = scales
        self._who = who
        self._pilots: dict[tuple[Subscriber, str], Pilot] = {}
        self._robots: dict[str, dict[str, Any]] = {}
        """The parameters of each robot."""
        self._services: dict[int, tuple[str, str, Service]] = {}
        """Robot, what is called, and the service."""
        self._ids = itertools.count(1)
        self._stops: dict[str, asyncio.Task[None]] = {}
        self._stop_again: set[str] = set()
        self._releases = Tasks()
        for what in _OF_ALL:
            self._add("", what)

    def __repr__(self) -> str:
        return f"<RobotCommands of {len(self._robots)} robots, {len(self._pilots)} pilots>"

    async def close(self) -> None:
        """Release all robots; stops that are on their way arrive."""
        pilots = [pilot.close() for pilot in self._pilots.values()]
        await asyncio.gather(*pilots, *self._stops.values(), *self._releases.running, return_exceptions=True)
        self._pilots.clear()

    # Robots come and go

    def robot_came(self, robot: str) -> None:
        """Offer the services and parameters of a robot."""
        self._robots[robot] = dict(_UNTOUCHED)
        services = [self._add(robot, what) for what in (*_OF_ALL, *_SWITCHES, "mode")]
        self._hub.say(replies.advertise_services(services))
        self._hub.parameters_changed({f"{robot}.{name}": value for name, value in self._robots[robot].items()})

    def robot_left(self, robot: str) -> None:
        """Withdraw the services of a robot."""
        self._robots.pop(robot, None)
        gone = [number for number, (owner, _, _) in self._services.items() if owner == robot]
        for number in gone:
            del self._services[number]
        self._hub.say(replies.text("unadvertiseServices", serviceIds=gone))

    def noted(self, robot: str, name: str, value: Any) -> None:
        if robot in self._robots and self._robots[robot].get(name) != value:
            self._robots[robot][name] = value
            self._hub.parameters_changed({f"{robot}.{name}": value})

    def _add(self, robot: str, what: str) -> Service:
        number = next(self._ids)
        name = f"/{robot}/{what}" if robot else f"/{what}"
        kind = f"zbridge/{what.capitalize()}"
        request = replies.json_schema(f"{kind}Request", _ASKED[what])
        service = Service(number, name, kind, request, replies.json_schema(f"{kind}Response", _ANSWERED))
        self._services[number] = (robot, what, service)
        return service

    # Topics

    def published(self, viewer: Subscriber, channel: ClientChannel, payload: bytes) -> None:
        """Drive or stop a robot; raise Refused for any other channel."""
        robot, what = self._aim(channel)
        if what == STOP:
            self._stop_soon(viewer, robot)
            return
        if channel.schema_name not in _TWISTS:
            raise Unsupported(f"{channel.topic}: schema {channel.schema_name!r:.80}: expected {_TWISTS[0]!r}")
        self._may(viewer)
        self._pilot(viewer, robot).drive(read_twist(payload, self._scales.get(robot, self._scales[""])))

    def unpublished(self, viewer: Subscriber, channel: ClientChannel) -> None:
        """Release the robot that was driven on a channel."""
        robot, _, what = channel.topic.strip("/").partition("/")
        pilot = self._pilots.pop((viewer, robot), None) if what == CMD_VEL else None
        if pilot is not None:
            self._releases.start(pilot.close())

    def _aim(self, channel: ClientChannel) -> tuple[str, str]:
        """Return the robot and what is published for it; raise Refused for anything else."""
        robot, _, what = channel.topic.strip("/").partition("/")
        if what not in (CMD_VEL, STOP) or not is_name(robot):
            raise Unsupported(f"{channel.topic}: expected /<robot>/{CMD_VEL} or /<robot>/{STOP}")
        if channel.encoding != "json":
            raise Unsupported(f"{channel.topic}: encoding {channel.encoding!r}: expected 'json'")
        self._known(robot)
        return robot, what

    def _pilot(self, viewer: Subscriber, robot: str) -> Pilot:
        pilot = self._pilots.get((viewer, robot))
        if pilot is None:

            def ended(error: ZbridgeError | None) -> None:
                if made.mode != "none":
                    self.noted(robot, "mode", "none")
                if error is not None:
                    viewer.warn(str(error))

            control = self._fleet[robot].control
            lease = partial(control, viewer.name, name=self._who, deadman_s=DEADMAN_S, wait_s=WAIT_S)
            pilot = self._pilots[viewer, robot] = made = Pilot(Stick(RULES), lease, on_end=ended)
        return pilot

    def _stop_soon(self, viewer: Subscriber, robot: str) -> None:
        """Stop a robot on a task. One runs for each robot; a stop that comes meanwhile makes it stop once more."""
        self._stopped([robot])
        if robot in self._stops:
            self._stop_again.add(robot)
        else:
            self._stops[robot] = asyncio.get_running_loop().create_task(self._stop_and_tell(viewer, robot))

    async def _stop_and_tell(self, viewer: Subscriber, robot: str) -> None:
        try:
            await self._stop([robot])
            while robot in self._stop_again:
                self._stop_again.discard(robot)
                await self._stop([robot])
        except ZbridgeError as error:
            viewer.warn(str(error))
        finally:
            self._stop_again.discard(robot)
            del self._stops[robot]

    def _stopped(self, robots: list[str]) -> None:
        for (_, robot), pilot in self._pilots.items():
            if robot in robots:
                pilot.require_neutral(f"{robot} was stopped")

    async def _stop(self, robots: list[str]) -> None:
        """Stop robots; raise Refused or BusError for the first that was not confirmed."""
        self._stopped(robots)
        _raise_first(await self._fleet.stop(robots))

    # Services and parameters

    def services(self) -> list[Service]:
        return [service for _, _, service in self._services.values()]

    async def call(self, viewer: Subscriber, service_id: int, payload: bytes) -> bytes:
        if service_id not in self._services:
            raise Unsupported(f"there is no service {service_id}")
        robot, what, service = self._services[service_id]
        try:
            asked = msgspec.json.decode(payload or b"{}", type=dict[str, Any])
        except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
            raise Malformed(f"{service.name}: {error}") from error
        await self._carry_out(viewer, robot, what, asked.get(_ARGUMENT.get(what, "on")))
        return b'{"ok":true}'

    def parameters(self, names: tuple[str, ...]) -> dict[str, Any]:
        """Return the parameters of these names, or all."""
        known = {f"{robot}.{name}": value for robot, values in self._robots.items() for name, value in values.items()}
        return {name: known[name] for name in names if name in known} if names else known

    async def set_parameter(self, viewer: Subscriber, name: str, value: Any) -> None:
        """Send the command that a parameter stands for; raise Refused or BusError."""
        robot, _, what = name.rpartition(".")
        if what not in _UNTOUCHED:
            raise Unsupported(f"{name}: there is no such parameter")
        self._known(robot)
        if what != STOP or value is True:
            await self._carry_out(viewer, robot, what, value)

    async def _carry_out(self, viewer: Subscriber, robot: str, what: str, value: Any) -> None:
        """Carry out a service for a robot, or for all. value: a latch's reason, the mode, or whether it is on."""
        robots = [robot] if robot else sorted(self._robots)
        if what == STOP:
            await self._stop(robots)
        elif what == LATCH:
            self._stopped(robots)
            _raise_first(await self._fleet.latch([robot] if robot else None, value if isinstance(value, str) else None))
        else:
            self._may(viewer)
            if what != UNLATCH:
                await self._set(viewer, robot, what, value)
            elif robot:
                await self._fleet[robot].unlatch()
            else:
                _raise_first(await self._fleet.unlatch())

    async def _set(self, viewer: Subscriber, robot: str, what: str, value: Any) -> None:
        expected = _MODES if what == "mode" else (True, False)
        if not isinstance(value, bool | str) or value not in expected:
            nested = isinstance(value, list | dict)  # perhaps deeper than repr allows
            found = f"a {type(value).__name__}" if nested else f"{value!r:.40}"
            raise Malformed(f"{what} = {found}: expected one of {', '.join(map(repr, expected))}")
        if what == "mode":
            await self._set_mode(viewer, robot, str(value))
        else:
            target = self._fleet[robot]
            switch = {"light": target.set_light, "lidar": target.set_lidar, "camera": target.set_camera}[what]
            await switch(value is True)
        self.noted(robot, what, value)  # what the robot then tells of it wins

    async def _set_mode(self, viewer: Subscriber, robot: str, mode: str) -> None:
        for (other, held), pilot in self._pilots.items():
            if held == robot and other is not viewer and pilot.stick.active:
                raise Held(f"{robot} is driven by {other.name}", holder=other.name)
        await self._pilot(viewer, robot).set_mode(mode)

    async def left(self, viewer: Subscriber) -> None:
        gone = [key for key in self._pilots if key[0] is viewer]
        await asyncio.gather(*(self._pilots.pop(key).close() for key in gone))

    def _known(self, robot: str) -> None:
        if robot not in self._robots:
            raise Unsupported(f"there is no robot {robot!r:.40}")

    def _may(self, viewer: Subscriber) -> None:
        if not viewer.may_drive:
            raise Unsupported("you may look and stop, not drive: that needs --drive, and a token or a listed Origin")


def _raise_first(outcomes: Mapping[str, Outcome]) -> None:
    for error in outcomes.values():
        if error is not None:
            raise error


_SWITCH = {"type": "object", "properties": {"on": {"type": "boolean"}}}
_ASKED: Mapping[str, Mapping[str, Any]] = {
    STOP: {"type": "object", "properties": {}},
    LATCH: {"type": "object", "properties": {"reason": {"type": "string"}}},
    UNLATCH: {"type": "object", "properties": {}},
    "mode": {"type": "object", "properties": {"mode": {"type": "string", "enum": list(_MODES)}}},
    **dict.fromkeys(_SWITCHES, _SWITCH),
}
_ARGUMENT = {LATCH: "reason", "mode": "mode"}
_ANSWERED = {"type": "object", "properties": {"ok": {"type": "boolean"}}}
