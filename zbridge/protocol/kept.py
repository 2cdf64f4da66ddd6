"""The state that an object hands over to the same object of another process, as values for MessagePack. Sans-IO.

Theory of operation. A class lists in ``kept`` the attributes that make up its state, each with its type. ``export``
writes them, ``restore`` sets them in an object newly made from the same settings. The constructor makes all other
attributes. An attribute that is :class:`Kept` itself is restored in place. Times need no conversion: all
processes of a machine share the clock of their event loops.

A state of another form (a missing field, another type, an unknown member of an enumeration) is rejected as a whole.

A gateway also deposits its state every second, for a successor if the process dies. Such a deposit has a
:class:`Budget`: large values of attributes marked as :class:`Spare` are left out, and the successor's object keeps what
its constructor made.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import msgspec

from zbridge.errors import ProtocolError

Exported = dict[str, Any]
"""A state: names and values that MessagePack holds."""


class Form(NamedTuple):
    """How one attribute is written and read back, if no type describes it."""

    write: Callable[[Any], Any]
    read: Callable[[Any], Any]


class Spare(NamedTuple):
    """An attribute that a deposit omits if its value is large. form: its type, or a :class:`Form`."""

    form: Any


class Budget:
    """Bounds each spare value of a deposit to ``most_bytes`` as MessagePack; collects what was left out."""

    def __init__(self, most_bytes: int) -> None:
        self.most_bytes = most_bytes
        self.left_out: dict[str, int] = {}
        """The bytes of each value that was left out, by its name."""

    def __repr__(self) -> str:
        return f"<Budget {self.most_bytes}, {len(self.left_out)} left out>"

    def admits(self, name: str, value: Any) -> bool:
        """Return whether a value is written; note it if not."""
        flat = isinstance(value, bytes | bytearray | None)
        size = len(value or b"") if flat else len(msgspec.msgpack.encode(value))
        if size > self.most_bytes:
            self.left_out[name] = size
        return size <= self.most_bytes


class Frame(bytes):
    """A frame of a special kind; all others are plain bytes. Subclasses keep their kind in a handover."""

    kinds: ClassVar[dict[str, type[bytes]]] = {"": bytes}

    def __init_subclass__(cls) -> None:
        Frame.kinds[f"{cls.__module__}.{cls.__qualname__}"] = cls


def _write_frame(frame: bytes | None) -> Any:
    if frame is None:
        return None
    kind = "" if type(frame) is bytes else f"{type(frame).__module__}.{type(frame).__qualname__}"
    return [kind, bytes(frame)]


def _read_frame(raw: Any) -> bytes | None:
    if raw is None:
        return None
    kind, data = msgspec.convert(raw, tuple[str, bytes])
    if kind not in Frame.kinds:
        raise ValueError(f"frame of an unknown kind {kind!r}")
    return Frame.kinds[kind](data)


FRAME = Form(_write_frame, _read_frame)
"""One frame, or None."""
FRAMES = Form(lambda frames: list(map(_write_frame, frames)), lambda raw: tuple(map(_read_frame, raw)))
"""A tuple, list or deque of frames."""


class Kept:
    """An object whose state another process can take over."""

    kept: ClassVar[Mapping[str, Any]] = {}
    """Attributes and their types, or a :class:`Form` or :class:`Spare`; those of the base classes are kept too."""

    def export(self, budget: Budget | None = None) -> Exported:
        """Write the state. budget: of a deposit; None: write everything."""
        state: Exported = {}
        for name, form in _attributes(type(self)).items():
            spare, form = isinstance(form, Spare), form.form if isinstance(form, Spare) else form
            value = _write(getattr(self, name), form, budget)
            if budget is None or not spare or budget.admits(f"{type(self).__name__}.{name}", value):
                state[name] = value
        return state

    def restore(self, state: Exported) -> None:
        """Take a state over; raise ProtocolError if it has another form. The object must not be used then."""
        for name, form in _attributes(type(self)).items():
            if isinstance(form, Spare):
                if name not in state:
                    continue
                form = form.form
            try:
                _restore(self, name, form, state[name])
            except (KeyError, TypeError, ValueError, msgspec.MsgspecError) as error:
                raise ProtocolError(f"{type(self).__name__}.{name}: {error or 'missing'}") from error


def _attributes(kind: type) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for base in reversed(kind.__mro__):
        found |= vars(base).get("kept", {})
    return found


def _write(value: Any, form: Any, budget: Budget | None) -> Any:
    if isinstance(value, Kept):
        return value.export(budget)
    if isinstance(form, Form):
        return form.write(value)
    return msgspec.to_builtins(list(value) if isinstance(value, deque) else value, builtin_types=(bytes, bytearray))


def _restore(owner: object, name: str, form: Any, raw: Any) -> None:
    present = getattr(owner, name)
    if isinstance(present, Kept):
        present.restore(raw)
        return
    value = form.read(raw) if isinstance(form, Form) else msgspec.convert(raw, form)
    if isinstance(present, deque):
        present.clear()
        present.extend(value)
    elif isinstance(present, Counter):
        present.clear()
        present.update(value)
    else:
        setattr(owner, name, value)
