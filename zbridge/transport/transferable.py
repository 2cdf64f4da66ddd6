"""What a restart hands to another process: the steps of a handover, and the descriptors in transit."""

from __future__ import annotations

import contextlib

from zbridge.errors import ProtocolError
from zbridge.protocol.kept import Exported
from zbridge.transport.kernel import KERNEL, Kernel


class Transferable:
    """A part of a gateway that is handed to a successor: the device, a listener, the claim on the robot.

    Theory of operation. The predecessor takes each step with all its parts before it takes the next one:

    1. ``prepare``: stop what moves, and wait until the part can be handed over.
    2. ``shut``: stop accepting peers.
    3. ``suspend``: read and write nothing, and run no timer. Input waits in the kernel.
    4. ``export``: describe the part as it is now; its descriptors go into the parcel.
    5. ``withdraw``, when the successor has restored and declared everything: leave the bus to it.
    6. ``detach``, when the successor has the robot: close this process's copies of the descriptors. No peer notices.

    If anything fails before the sixth step, ``resume`` takes everything back, once the successor has ended.

    The successor makes the same parts from the same settings, and takes two steps with each:

    1. ``restore``: take the exported state. Nothing is read or written yet.
    2. ``resume``, when the predecessor has detached: attach the descriptors, read and write.

    A part overrides the steps that it needs. Its components (connection, conversation, link, client, door) use the same
    names for their share of a step; most of those do not wait.
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
        """Close what the successor has now."""

    async def restore(self, state: Exported, parcel: Parcel) -> None:
        """Take the state that another process exported; raise ProtocolError. Call once, on a newly made part."""

    async def resume(self) -> None:
        """Undo the steps since ``prepare``, or begin with the restored state."""


class Parcel:
    """Descriptors in the order of their numbers; ``descriptors``: received from another process, if any.

    Descriptors that are put are duplicated: the sockets stay as they are. Close the parcel once it is sent, or
    unpacked.
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
