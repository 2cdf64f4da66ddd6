"""Decides which connections become viewers, and which viewers may drive. Sans-IO.

A web page of anybody that is open in an operator's browser can connect to loopback; its Origin tells, and a browser
does not let it lie. A program can send any Origin, or none: only the token tells programs apart.
"""

from __future__ import annotations

import hmac
from collections.abc import Sequence
from http import HTTPStatus
from urllib.parse import parse_qs, urlsplit

import msgspec

from zbridge.fleet.topics import escape
from zbridge.hq.admission import Arrivals
from zbridge.protocol.networks import Network, is_among
from zbridge.views.foxglove.replies import SUBPROTOCOL

FOXGLOVE_ORIGINS = ("https://app.foxglove.dev",)
"""The Origin of Foxglove's own page. Native programs send none."""
ACCEPT_HZ = 20.0
"""Connections a second that are accepted from one address."""
LABEL = 24
"""Characters that are kept of what a viewer calls itself."""


class Policy(msgspec.Struct, frozen=True):
    """Who may connect, and who may drive.

    networks: empty for all. token: needed by everybody, None: by nobody. drive: whether anybody may drive at all.
    who: what drivers are called first; access rules know them by it.
    """

    origins: tuple[str, ...] = FOXGLOVE_ORIGINS
    networks: tuple[Network, ...] = ()
    token: str | None = None
    drive: bool = False
    viewers: int = 32
    who: str = "foxglove"


class Rejection(msgspec.Struct, frozen=True):
    """A connection that is turned away. reason: one word, for counters; text: for people."""

    status: HTTPStatus
    reason: str
    text: str


class Admitted(msgspec.Struct, frozen=True):
    """A connection that becomes a viewer. label: what it calls itself, or its address."""

    label: str
    may_drive: bool


class ViewerAdmission:
    """Admits connections as the policy says."""

    def __init__(self, policy: Policy) -> None:
        self.policy = policy
        self._arrivals = Arrivals(ACCEPT_HZ)

    def refusal(self, host: str, connections: int, now: float) -> str | None:
        """Return why a connection is closed before it sends anything, as one word; None if it may continue."""
        if self.policy.networks and not is_among(host, self.policy.networks):
            return "network"
        if not self._arrivals.admit(host, now):
            return "arrivals"
        return "full" if connections >= 2 * self.policy.viewers else None

    def admit(
        self, path: str, origins: Sequence[str], subprotocols: Sequence[str], host: str, viewers: int
    ) -> Admitted | Rejection:
        """Decide about an opening handshake. origins, subprotocols: of all headers of that name."""
        if any(origin not in self.policy.origins for origin in origins):
            return Rejection(HTTPStatus.FORBIDDEN, "origin", "this Origin is not allowed")
        query = parse_qs(urlsplit(path).query, max_num_fields=16)
        if self.policy.token is not None:
            given = query.get("token", [""])[0]
            if not hmac.compare_digest(given.encode(), self.policy.token.encode()):
                return Rejection(HTTPStatus.UNAUTHORIZED, "token", "the token is missing or wrong")
        if viewers >= self.policy.viewers:
            return Rejection(HTTPStatus.SERVICE_UNAVAILABLE, "full", "as many viewers as there can be")
        if SUBPROTOCOL not in subprotocols:
            return Rejection(HTTPStatus.BAD_REQUEST, "subprotocol", f"expected the subprotocol {SUBPROTOCOL}")
        trusted = self.policy.token is not None or bool(origins)
        name = escape(query.get("name", [""])[0] or host)[:LABEL]
        return Admitted(name, self.policy.drive and trusted)
