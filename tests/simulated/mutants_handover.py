"""Broken variants of the restart with handover."""

from __future__ import annotations

from tests.simulated.mutants_data import DEVICE, Mutant

SEQUENCE = "zbridge/app/handover/sequence.py"
LISTENER = "zbridge/hq/handover.py"
SESSION = "zbridge/protocol/session.py"


def _mutant(name: str, file: str, old: str, new: str) -> Mutant:
    return Mutant(name, "restart", file, old, new)


HANDOVER = (
    _mutant(
        "the robot is not stopped before a restart",
        DEVICE,
        "        self.enforcer.stop(reason, StopCause.RESTART)\n        self._context.pump()\n",
        "        self._context.pump()\n",
    ),
    _mutant(
        "the gateway before reads and writes on",
        DEVICE,
        "        for connection in self._links:\n            connection.suspend()\n",
        "",
    ),
    _mutant(
        "a successor begins before go",
        SEQUENCE,
        "            await self._channel.receive(Go, GO_S)\n",
        "            pass\n",
    ),
    _mutant(
        "an incomplete frame is lost",
        SESSION,
        "list(self._frames.partial() or ())",
        '[b"", 0]',
    ),
    _mutant(
        "an incomplete frame is read twice",
        SESSION,
        "        self._frames.resume(partial)\n",
        "        self._frames.resume(Partial(2 * partial.rest, partial.skip))\n",
    ),
    _mutant(
        "a successor does not know the latched stops",
        "zbridge/control/authority.py",
        "        self.latches.restore(state)\n"
        "        if self.latches:\n            self.machine.state = State.LATCHED\n",
        "        self.machine.state = State.FREE\n",
    ),
    _mutant(
        "HQ programs are not handed over",
        LISTENER,
        '        for each in state["clients"]:',
        "        for each in ():",
    ),
    _mutant("a successor's listener stays shut", LISTENER, "        await self._door.open()\n", ""),
    _mutant("the gateway before takes leave of the robot", DEVICE, "        self._detached.set()\n", ""),
    _mutant(
        "a gateway that ends hands over meanwhile",
        "zbridge/app/gateway.py",
        "together(*work, first=self.restarts.settle)",
        "together(*work)",
    ),
)
