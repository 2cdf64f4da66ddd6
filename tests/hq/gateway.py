"""The robot's end of the bus in scenes of HQ programs. Times are made up."""

from __future__ import annotations

from typing import Any

from tests.fake_bus import FakeBus
from tests.proofs import numbered
from zbridge.bus.interface import IncomingQuery, Sample
from zbridge.control.authority import Authority
from zbridge.errors import Refused, Stale
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.lease_messages import Acquire
from zbridge.fleet.messages import Control, Drive, FleetMessage, Mode, Motor, Raw
from zbridge.fleet.topics import KeySpace
from zbridge.hq.intent import LEASE_S
from zbridge.lease.proof import read

KEYS = KeySpace("fleet", "r1")


class Gateway:
    """The robot's end of the bus: the lease as it is, and every command with what became of it.

    scene: ``scene.now`` is the time.
    """

    def __init__(self, bus: FakeBus, scene: Any) -> None:
        self.bus = bus
        self.scene = scene
        self.authority = Authority(LEASE_S, 2.0, numbered())
        self.commands: list[tuple[str, FleetMessage]] = []
        self.refused: list[str] = []
        self.asked: list[str] = []
        self.requests: list[Acquire] = []
        self.control = bus.publisher(KEYS.key("control"), topics.CONTROL)
        bus.subscribe(KEYS.key("@cmd/**"), self._take)
        for name in ("acquire/*", "renew", "release"):
            bus.answer(KEYS.key(f"@rpc/control/{name}"), self._decide)
        bus.watch_alive(KEYS.alive("*"), self._on_alive)

    def _decide(self, question: IncomingQuery) -> None:
        what, _, name = KEYS.path(question.key).removeprefix("@rpc/control/").partition("/")
        self.asked.append(what)
        now = self.scene.now
        if what == "acquire":
            self.requests.append(request := payloads.decode(Acquire, question.payload))
            assert request.who.startswith(f"{name}."), "asked in the name of the listener"
            lease = self.authority.acquire(request, now, now * 1000)
        elif what == "renew":
            lease = self.authority.renew(read(question.payload), question.asked, now, now * 1000)
        else:
            lease = self.authority.release(read(question.payload), question.asked, now)
        question.answer(payloads.encode(lease))

    def _take(self, sample: Sample) -> None:
        topic = topics.find(KEYS.path(sample.key))
        assert topic is not None
        message = payloads.decode(topic.message, sample.payload)
        if isinstance(message, Drive | Motor | Mode | Raw):
            who, now = None, self.scene.now
            try:
                sender = self.authority.admit(sample.attachment, sample.key, sample.payload, now, now * 1000)
                who, moving = sender.who, isinstance(message, Drive | Motor) and message.moving
                if moving and sender.stale:
                    raise Stale("too late")
                if moving:
                    self.authority.motion.check_motion()
                if isinstance(message, Drive | Motor):
                    self.authority.applied(topic.path, sender.given_at, moving=moving, stale=sender.stale)
            except Refused as refusal:
                self.refused.append(str(refusal))
                self.authority.refuse(topic.path.removeprefix("@cmd/"), refusal, refusal.who or who)
                return
        else:
            assert sample.attachment is None
        self.commands.append((topic.path.removeprefix("@cmd/"), message))

    def _on_alive(self, key: str, alive: bool) -> None:
        if not alive:
            self.authority.vanished(key.removeprefix(KEYS.alive("")))

    def report(self) -> Control:
        self.authority.expire(self.scene.now)
        return self.authority.report(self.scene.now)

    def taken(self) -> list[tuple[str, FleetMessage]]:
        """What was carried out since the last call."""
        commands, self.commands = self.commands, []
        return commands
