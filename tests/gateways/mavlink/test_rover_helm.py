"""The helm against a rover whose link delays and loses, and whose pilot acts: who moves it, and who gets it back."""

from __future__ import annotations

import contextlib
from collections import deque

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateways.mavlink import PROTOCOL
from gateways.mavlink.frames import read_frame
from gateways.mavlink.messages import MavlinkMessage
from gateways.mavlink.messages.control import CommandAck, CommandLong, ManualControl, SetPositionTargetLocalNed
from gateways.mavlink.messages.telemetry import MavlinkHeartbeat
from gateways.mavlink.numbers import Command, RoverMode
from gateways.mavlink.simulator import ArduRover
from zbridge.errors import Refused
from zbridge.protocol import State
from zbridge.simulation.scene import Scene

QUIET = {"position_hz": 0.0, "ranges_hz": 0.0, "status_hz": 0.0}
PILOTS = (RoverMode.STEERING, RoverMode.AUTO, RoverMode.LOITER)
KINDS = (MavlinkHeartbeat, CommandLong, CommandAck, SetPositionTargetLocalNed)
GIVEN_BACK = ManualControl(y=32767, z=32767, target=1)


class TroubledRover(ArduRover):
    """A rover behind a slow link. late_s: of its HEARTBEATs. lost: kinds of messages that are lost, each way."""

    def __init__(self) -> None:
        self.late_s = 0.0
        self.lost: set[type[MavlinkMessage]] = set()
        self._held: deque[tuple[float, MavlinkMessage]] = deque()
        super().__init__(GUID_TIMEOUT=60.0)

    def send(self, *messages: MavlinkMessage) -> None:
        for message in messages:
            if type(message) in self.lost:
                continue
            if isinstance(message, MavlinkHeartbeat) and (self.late_s or self._held):
                self._held.append((self._now + self.late_s, message))
            else:
                super().send(message)

    def step(self, dt: float) -> bytes:
        while self._held and self._held[0][0] <= self._now:
            super().send(self._held.popleft()[1])
        return super().step(dt)

    def _obey(self, message: MavlinkMessage, sender: int) -> None:
        if type(message) not in self.lost:
            super()._obey(message, sender)


class Trial:
    """A scene in which things happen, and what must hold after each."""

    def __init__(self, how: str) -> None:
        self.rover = TroubledRover()
        self.rover.switch_arming(True)
        self.scene = Scene(PROTOCOL, self.rover, {"drive": how, "arm": "drive"} | QUIET)
        self.scene.establish()
        self._pilots: RoverMode | None = None
        """The mode that the pilot set, once it was shown to us; None: it may be left."""
        self._checked = len(self.scene.written)
        self._stopped = True

    def happen(self, what: str, value: float) -> None:
        rover, scene = self.rover, self.scene
        if what in ("drive", "stop", "pilot"):
            self._pilots = None
        with contextlib.suppress(Refused):
            match what:
                case "drive" | "neutral":
                    scene.drive(0.5 if what == "drive" else 0.0)
                case "rest":
                    scene.rest()
                case "stop":
                    scene.stop()
                case "late":
                    rover.late_s = value
                case "lose":
                    rover.lost ^= {KINDS[int(value * 7)]}
                case "pilot":
                    rover.switch_mode(PILOTS[int(value * 5)])
                case "arming":
                    rover.switch_arming(not rover.armed)
                case "connect":
                    scene.connect()
        scene.run(0.05 + value)
        self.check()
        if rover.mode in PILOTS and scene.robot.helm.mode == rover.mode and not scene.robot.helm.ours:
            self._pilots = rover.mode

    def check(self) -> None:
        """Motion leaves only while our mode was asked for since the last stop, and a pilot keeps the mode."""
        assert self._pilots in (None, self.rover.mode)
        for frame in self.scene.written[self._checked :]:
            message = read_frame(frame).message
            if isinstance(message, CommandLong) and message.command == Command.DO_SET_MODE:
                self._stopped = message.param2 == RoverMode.HOLD
            elif isinstance(message, SetPositionTargetLocalNed):
                assert not (self._stopped and message.vx)
            elif isinstance(message, ManualControl) and message != GIVEN_BACK:
                assert not (self._stopped and message.z)
        self._checked = len(self.scene.written)

    def rest(self, seconds: int) -> None:
        """Let nobody drive: the gateway rests once a second."""
        for _ in range(seconds):
            with contextlib.suppress(Refused):
                self.scene.rest(0.0)
            self.scene.run(1.0)
        self.check()


EVENTS = ("drive", "drive", "neutral", "rest", "stop", "late", "lose", "pilot", "arming", "connect")
STEPS = st.lists(
    st.tuples(st.sampled_from(EVENTS), st.sampled_from([0.0, 0.1, 0.2, 0.3, 0.5])), min_size=1, max_size=12
)


@pytest.mark.parametrize("how", ["guided", "manual"])
@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(steps=STEPS, whole=st.booleans())
def test_nobody_is_driven_by_us_for_long_and_pilots_keep_what_they_took(how, steps, whole) -> None:
    trial = Trial(how)
    rover, scene = trial.rover, trial.scene
    for what, value in steps:
        trial.happen(what, value)
    if scene.session.state is State.ESTABLISHED:  # without an answer, but obeyed
        rover.lost &= set() if whole else {MavlinkHeartbeat, CommandAck}
        trial.rest(2)
        assert rover.mode in PILOTS or rover.truth().neutral
    rover.lost, rover.late_s = set(), 0.0
    rover.switch_arming(True)
    if scene.session.over:
        scene.connect()
    trial.rest(3)
    assert rover.mode in (RoverMode.HOLD, *PILOTS)
    assert not scene.robot.helm.overrides
    trial.happen("pilot", 0.1)  # and now the pilot takes it
    since = len(scene.written)
    trial.rest(2)
    with contextlib.suppress(Refused):
        scene.drive(0.0)
    trial.rest(1)
    messages = [read_frame(frame).message for frame in scene.written[since:]]
    assert not [each for each in messages if isinstance(each, SetPositionTargetLocalNed | ManualControl)]
    assert rover.mode is RoverMode.STEERING
