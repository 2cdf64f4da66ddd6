"""The names of listeners and of their process on the bus. Sans-IO.

On a secure bus they begin with the name in the certificate of the process: the rules of the router let it ask, live and
answer as ``hq.<own name>`` only. Two processes may have the same certificate, so names that nobody chose end with the
id of the bus session.
"""

from __future__ import annotations

from collections.abc import Sequence

from zbridge.errors import ConfigError
from zbridge.hq.settings import ListenerPlan
from zbridge.lease.lease_events import NAMED

_ZID = 6
"""Characters of the bus session's id in a listener's name: they differ between processes."""
_MOST = NAMED - len("hq.") - len(".65535")
"""Characters of a listener's name that leave room for its clients' numbers in what ``control`` shows."""


def listener_names(plans: Sequence[ListenerPlan], own: str | None, zid: str) -> list[str]:
    """Return the names of the listeners: as configured, else unique by the id of the bus session.

    own: the name in the certificate of the process, None without one. Raises ConfigError for a name that is too long.
    """
    names: list[str] = []
    for number, plan in enumerate(plans):
        name = plan.settings.name
        if name is None:
            name = _of_member(f"{plan.protocol.name}-{zid[:_ZID]}", own)
            name = f"{name}-{number + 1}" if name in names else name
        else:
            name = _of_member(name, own)
        if len(name) > _MOST:
            raise ConfigError(f"hq[{number}].name: {name!r} has more than {_MOST} characters: expected a shorter name")
        if name in names:
            raise ConfigError(f"hq[{number}].name: {name!r} is another listener's name on the bus: expected its own")
        names.append(name)
    return names


def process_name(listeners: Sequence[str], own: str | None, zid: str) -> str:
    """Return the name of a process that serves HQ programs: ``hq.<own name>.<zid>``.

    Its own name is that in its certificate; without one that of its first listener.
    """
    return ".".join(("hq", own or listeners[0], zid))


def _of_member(name: str, own: str | None) -> str:
    """Return a name that begins with the process's own."""
    return name if own is None or name == own or name.startswith(f"{own}.") else f"{own}.{name}"
