"""What a restart hands to another process: the steps of a handover, and the descriptors on their way."""

from __future__ import annotations

import contextlib

from zbridge.errors import ProtocolError
from zbridge.protocol.kept import Exported
from zbridge.transport.kernel import KERNEL, Kernel


class Transferable:
    """A part of a gateway that a successor gets: the device, a listener, the claim on the robot.

    Theory of operation. The gateway that goes takes each step with all its parts before it takes the next one:

    1. ``prepare``: stop what moves, and wait until the part can be handed over.
    2. ``shut``: accept nobody any more.
    3. ``suspend``: read and write nothing, and run no timer. What comes waits in the kernel.
    4. ``export``: describe the part, a value of that moment; its descriptors go into the parcel.
    5. ``withdraw``, when the successor has restored and declared everything: leave the bus to it.
    6. ``detach``, when the successor has the robot: close the own copies of the descriptors. No peer notices.

    If anything fails before the sixth step, ``resume`` takes everything back, once the successor has ended.

    The successor makes the same parts from the same settings, and takes two steps with each:

    1. ``restore``: be what was exported. Nothing is read or written yet.
    2. ``resume``, when the other gateway has let go: attach the descriptors, read and write.

    A part overrides the steps that concern it. What a part consists of (connection, conversation, link, client, door)
    has the same names for its share of a step; most of those do not wait.
    """

    async def prepare(self, reason: str, within_s: float) -> None:
        """Stop what moves, and wait until the part can be handed over; raise Refused after ``within_s``."""

    async def shut(self) -> None:
        """Accept nobody until :meth:`resume`."""

    def suspend(self) -> None:
        """Read and write nothing until :meth:`resume`."""

    def export(self, parcel: Parcel) -> Exported:
        """Describe the part, with its descriptors in the parcel; call while suspended."""
        raise NotImplementedError

    async def withdraw(self) -> None:
        """Take no commands from the bus, and claim nothing on it, until :meth:`resume`; wait until it knows."""

    async def detach(self) -> None:
        """Give up what the successor has now."""

    async def restore(self, state: Exported, parcel: Parcel) -> None:
        """Be what another process exported; raise ProtocolError. Call once, on a part that was just made."""

    async def resume(self) -> None:
        """Take the steps since ``prepare`` back, or begin with what was restored."""


class Parcel:
    """Descriptors in the order of their numbers; ``descriptors`` of another process where they came from one.

    Those that were put are duplicates: the own sockets stay as they are. Close the parcel when it was sent, or taken.
    """

    def __init__(self, descriptors: list[int] | None = None, kernel: Kernel = KERNEL) -> None:
        self._kernel = kernel
        self.descriptors: list[int] = list(descriptors or ())
        self._taken: set[int] = set()

    def __len__(self) -> int:
        return len(self.descriptors)

    def __repr__(self) -> str:
        return f"<Parcel of {len(self)} descriptors, {len(self._taken)} taken>"

    def put(self, descriptor: int) -> int:
        """Add a duplicate of a descriptor; return its number."""
        self.descriptors.append(self._kernel.duplicate(descriptor))
        return len(self.descriptors) - 1

    def take(self, number: object) -> int:
        """Take a descriptor out, once; raise ProtocolError if there is none of this number."""
        if not isinstance(number, int) or not 0 <= number < len(self.descriptors) or number in self._taken:
            raise ProtocolError(f"no descriptor {number!r} among {len(self.descriptors)}")
        self._taken.add(number)
        return self.descriptors[number]

    def close(self) -> None:
        """Close what was not taken; idempotent."""
        for number, descriptor in enumerate(self.descriptors):
            if number not in self._taken:
                self._taken.add(number)
                with contextlib.suppress(OSError):
                    self._kernel.close(descriptor)
