"""What a gateway process left with its supervisor, for the case that it dies: a stop, sockets, and its state.

Theory of operation. A process that takes over is given the deposit of the process before it
(:meth:`Deposit.predecessor`), which counts until it makes one of its own. Between the two it may have opened links, and
read from them. So each question goes link by link, by the link's name, to the newest deposit that has an answer.
"""

from __future__ import annotations

import os

import msgspec

from zbridge.app.handover.channel import HandoverState
from zbridge.errors import HandoverError
from zbridge.host.duplicates import Duplicates
from zbridge.host.fd_channel import Deposited
from zbridge.host.memory import MemoryReader
from zbridge.robot.observer import LastStop
from zbridge.transport import Parcel
from zbridge.wire.frames import Partial


class Deposit:
    """The deposit of one process; open until :meth:`close`."""

    def __init__(self) -> None:
        self.last = LastStop()
        """The stop of its robot."""
        self.deposited: Deposited | None = None
        """Where its state is in the memory; None: it has made no deposit yet."""
        self.duplicates = Duplicates()
        self.memory: MemoryReader | None = None
        self.predecessor: Deposit | None = None
        """The deposit of the process before, until this one has made its own."""

    def __repr__(self) -> str:
        return f"<Deposit {self.deposited} after {self.predecessor}>"

    def note(self, deposited: Deposited) -> None:
        """Note that the process has made a deposit."""
        self.deposited = deposited
        self._drop_predecessor()

    def share(self, descriptor: int) -> None:
        """Map the memory that the process shares; memory of another version is of no use."""
        try:
            self.memory = MemoryReader(descriptor)
        except (OSError, ValueError):
            os.close(descriptor)

    def closed(self, link: int) -> None:
        """Close the duplicates of a link that the process has closed on purpose."""
        name = self.duplicates.name_of(link)
        self.duplicates.closed(link)
        if self.predecessor is not None and name is not None and self.duplicates.link_of(name) is None:
            for each in self.predecessor._chain:
                while (older := each.duplicates.link_of(name)) is not None:
                    each.duplicates.closed(older)

    async def stop(self, times: int) -> bool | None:
        """Write the robot's stop so often; whether its link accepted it, None if there is no link or no stop."""
        linked = next((each for each in self._chain if len(each.duplicates)), self)
        return await linked.duplicates.stop(self.last_stop, times)

    @property
    def last_stop(self) -> LastStop:
        """The newest stop that has frames, while the process has made no deposit of its own."""
        chain = self._chain
        return next((each.last for each in chain if each.last.frames), chain[-1].last)

    @property
    def has_links(self) -> bool:
        """Whether a connection is held open here."""
        return any(len(each.duplicates) for each in self._chain)

    def inheritance(self) -> tuple[HandoverState, Parcel]:
        """Return what a successor of the dead process can take over; raise HandoverError with the reason for nothing.

        Raises OSError if there is no free descriptor.
        """
        state, sockets = self._state()
        partials = [self._partial(name) for name, at in sockets if at == 0]
        descriptors = [number for name, at in sockets if (number := self._descriptor(name, at)) is not None]
        if not sockets:
            raise HandoverError("it left no state that a successor could take over")
        if len(descriptors) < len(sockets):
            raise HandoverError("it had written half a frame, or its link was being closed")
        if None in partials:
            raise HandoverError("it died while it read: the position in its stream is unknown")
        try:
            given = msgspec.msgpack.decode(state, type=HandoverState)
        except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
            raise HandoverError(f"its deposit is invalid: {error}") from error
        parcel = Parcel()
        try:
            for number in descriptors:
                parcel.put(number)
        except OSError:
            parcel.close()
            raise
        return msgspec.structs.replace(given, partials=tuple(each for each in partials if each is not None)), parcel

    async def drain(self) -> None:
        """Close everything, but first let the robot read its stop."""
        for each in self._chain:
            await each.duplicates.drain()

    def close(self) -> None:
        """Close everything; idempotent."""
        self.duplicates.close()
        if self.memory is not None:
            self.memory.close()
            self.memory = None
        self._drop_predecessor()

    def _drop_predecessor(self) -> None:
        if self.predecessor is not None:
            self.predecessor.close()
            self.predecessor = None

    # Link by link

    @property
    def _chain(self) -> tuple[Deposit, ...]:
        """This deposit, and those before it that still count, the newest first."""
        return (self, *(self.predecessor._chain if self.predecessor is not None else ()))

    def _state(self) -> tuple[bytes, tuple[tuple[str, int], ...]]:
        """Return the newest state, and its sockets by the names of their links."""
        newest = next((each for each in self._chain if each.deposited is not None), None)
        if newest is None or newest.memory is None or (deposited := newest.deposited) is None:
            return b"", ()
        names = [(newest.duplicates.name_of(link), at) for link, at in deposited.sockets]
        if not names or any(name is None for name, _ in names):
            return b"", ()
        data = newest.memory.deposit(deposited.area, deposited.size)
        return data, tuple((name, at) for name, at in names if name is not None)

    def _partial(self, name: str) -> Partial | None:
        """Return where the stream of a link was cut; None if nobody can resume it."""
        for each in self._chain:
            if (link := each.duplicates.link_of(name)) is not None:
                if each.memory is None:
                    return None
                if each.memory.is_touched(link) or each.predecessor is None:
                    return each.memory.partial(link)
        return None

    def _descriptor(self, name: str, at: int) -> int | None:
        """Return a descriptor of a link; None if there is none, or half a frame was written."""
        for each in self._chain:
            if (link := each.duplicates.link_of(name)) is not None:
                return each.duplicates.descriptor(link, at)
        return None
