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
            self.predecessor.close_named(name)

    def close_named(self, name: str) -> None:
        """Do the same for all links of this name."""
        while (link := self.duplicates.link_of(name)) is not None:
            self.duplicates.closed(link)
        if self.predecessor is not None:
            self.predecessor.close_named(name)

    async def stop(self, times: int) -> bool | None:
        """Write the robot's stop so often; whether its link accepted it, None if there is no link or no stop."""
        last = self.last_stop
        at = self
        while not len(at.duplicates) and at.predecessor is not None:
            at = at.predecessor
        return await at.duplicates.stop(last, times)

    @property
    def last_stop(self) -> LastStop:
        """The newest stop that has frames, while the process has made no deposit of its own."""
        if self.last.frames or self.predecessor is None:
            return self.last
        return self.predecessor.last_stop

    @property
    def has_links(self) -> bool:
        """Whether a connection is held open here."""
        return bool(len(self.duplicates)) or (self.predecessor is not None and self.predecessor.has_links)

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
        await self.duplicates.drain()
        if self.predecessor is not None:
            await self.predecessor.drain()

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

    def _state(self) -> tuple[bytes, tuple[tuple[str, int], ...]]:
        """Return the newest state, and its sockets by the names of their links."""
        if self.deposited is None:
            return self.predecessor._state() if self.predecessor is not None else (b"", ())
        names = [(self.duplicates.name_of(link), at) for link, at in self.deposited.sockets]
        if self.memory is None or not names or any(name is None for name, _ in names):
            return b"", ()
        data = self.memory.deposit(self.deposited.area, self.deposited.size)
        return data, tuple((name, at) for name, at in names if name is not None)

    def _partial(self, name: str) -> Partial | None:
        """Return where the stream of a link was cut; None if nobody can resume it."""
        link = self.duplicates.link_of(name)
        if link is not None:
            if self.memory is None:
                return None
            if self.memory.is_touched(link) or self.predecessor is None:
                return self.memory.partial(link)
        return self.predecessor._partial(name) if self.predecessor is not None else None

    def _descriptor(self, name: str, at: int) -> int | None:
        """Return a descriptor of a link; None if there is none, or half a frame was written."""
        link = self.duplicates.link_of(name)
        if link is not None:
            return self.duplicates.descriptor(link, at)
        return self.predecessor._descriptor(name, at) if self.predecessor is not None else None
