"""One Zenoh router process: opens it, tells members their roles, and logs who connects and whom Zenoh refuses, and why.

Zenoh accepts every certificate of its authority whatever the name, and an unknown name receives nothing. So each member
can query ``<realm>/@bus/whoami/<name>``, which the access rules permit only to that name: no answer means that this
router does not know the name.
"""

from __future__ import annotations

import asyncio
import logging
import re
import time
from collections.abc import Callable

from zbridge.bus import IncomingQuery, Neighbour, open_router
from zbridge.errors import BusError
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.processes import Membership
from zbridge.log import Log
from zbridge.metrics import Metrics
from zbridge.security.router_settings import RouterPlan, zenoh_values
from zbridge.toml import prefixed

log = Log("zbridge.security.router")


class Router:
    """A router, from its plan to its end. clock_ns: Unix time."""

    def __init__(self, plan: RouterPlan, clock_ns: Callable[[], int] = time.time_ns) -> None:
        self._plan = plan
        self._clock_ns = clock_ns
        self._known = {plan.roles.common_name(name) for name in plan.roles.names}

    def __repr__(self) -> str:
        return f"<Router {' '.join(self._plan.settings.listen)}>"

    async def run(self) -> None:
        """Route until cancelled; raise ConfigError if an address or a TLS file cannot be used."""
        settings = self._plan.settings
        with prefixed(f"no router at {', '.join(settings.listen)}: ", BusError):
            bus = await open_router(zenoh_values(self._plan), Metrics(), self.note)
        try:
            if settings.tls is not None:
                bus.answer(topics.whoami(settings.realm, "*"), self.answer)
            at = ", ".join(settings.listen)
            log.info("router_ready", "router at {address}: {summary}", address=at, summary=self._summary())
            await asyncio.Event().wait()
        finally:
            await bus.close()

    def note(self, neighbour: Neighbour, here: bool) -> None:
        """Log a process that connects or leaves."""
        name = neighbour.name or "somebody"
        if not here:
            log.info("member_left", "{name} left, from {peer}", name=name, peer=neighbour.address)
        elif self._plan.settings.tls is not None and neighbour.name not in self._known:
            log.warning(
                "member_unknown",
                "{name} connected from {peer}: its certificate is of this authority, but roles.toml does not name it:"
                " it hears nothing and may do nothing",
                name=name,
                peer=neighbour.address,
            )
        else:
            log.info("member_connected", "{name} connected from {peer}", name=name, peer=neighbour.address)

    def answer(self, query: IncomingQuery) -> None:
        """Answer a member's query for its role."""
        name = query.asked.rpartition("/")[2]
        member = self._plan.roles.names.get(name)
        if member is not None:
            known = Membership(name=name, role=member.role, robots=member.robots, stamp_ns=self._clock_ns())
            query.answer(payloads.encode(known))

    def _summary(self) -> str:
        if self._plan.settings.tls is None:
            return "without tls, whoever reaches it may do everything"
        names = self._plan.roles.names
        robots = {robot for member in names.values() for robot in member.robots}
        return f"mutual TLS, {len(names)} names, {len(robots)} robots in realm {self._plan.settings.realm}"


def log_zenoh_line(line: str) -> None:
    """Log a line of Zenoh's log in the terms of this project."""
    level, text = translate_log_line(line)
    log.log(level, "zenoh", "{warning}", warning=text)


def translate_log_line(line: str) -> tuple[int, str]:
    """Return the level and the text of one line of Zenoh's log."""
    for pattern, text in _WORDS:
        if (found := re.search(pattern, line)) is not None:
            return logging.WARNING, found.expand(text)
    match = _LINE.match(line)
    if match is None or _LOGGED_ELSEWHERE in line:
        return logging.DEBUG, line
    level = logging.getLevelNamesMapping().get(match["level"], logging.DEBUG)  # TRACE is Zenoh's alone
    return level, f"Zenoh: {_TAIL.sub('', match['text'])}"


_LINE = re.compile(r"\S+Z\s+(?P<level>ERROR|WARN|INFO|DEBUG|TRACE) .*?(?P<text>zenoh\S*: .*)")
_TAIL = re.compile(r"\.? Hint: increase the system open file limit\.|\s+at /\S+\.rs:\d+\.?")
_LOGGED_ELSEWHERE = "Unable to open listener"
"""Also an error, which ends the process with its text."""
_REFUSED = "refused a connection:"
_RENEW = "its certificate has expired (zbridge certs renew)"
_WORDS = (
    (
        r"Max transports reached \((\d+)\). Denying new transport with peer: (\w+)",
        rf"{_REFUSED} all limits.sessions = \1 are used (session \2)",
    ),
    ("remote certificate chain expired", f"closed a connection: {_RENEW}"),
    ("certificate expired", f"{_REFUSED} {_RENEW}, or a clock is wrong"),
    ("not valid yet", f"{_REFUSED} its certificate is not valid yet: the clock of one machine is wrong"),
    ("peer sent no certificates", f"{_REFUSED} it showed no certificate"),
    ("UnknownIssuer|BadSignature", f"{_REFUSED} its certificate is of another authority"),
    ("InvalidContentType", f"{_REFUSED} it spoke no TLS: plain TCP, or something else than Zenoh"),
    ("invalid peer certificate", f"{_REFUSED} its certificate is not valid"),
    ("UnknownCA", f"{_REFUSED} it does not know the authority of this router's certificate"),
    ("CertificateExpired", f"{_REFUSED} it says that this router's certificate has expired"),
    ("received fatal alert", f"{_REFUSED} it did not accept this router's certificate: its name, authority or dates"),
    ("handshake eof|[Uu]nexpected eof", f"{_REFUSED} it ended before it had said who it was"),
    ("Unknown \\w+ id", "a member took back a token, subscription or queryable that its rules had not let through"),
    ("Too many open files", "no more connections: this process may open no more files (ulimit -n)"),
)
"""Patterns of Zenoh's lines, and what is logged instead. The first match counts."""
