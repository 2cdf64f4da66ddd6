"""Descriptors of sockets and lines on their way to another process, which knows each by its number."""

from __future__ import annotations

import contextlib

from zbridge.errors import ProtocolError
from zbridge.transport.kernel import KERNEL, Kernel


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
        """Take a descriptor out, once; raise ProtocolError where there is none of this number."""
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
