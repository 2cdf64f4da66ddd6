"""Whose datagrams are an HQ program's: the port of its host from which they are taken. Sans-IO.

Source: "The gateway as robot" and "Handshake", Ports, of the protocol page.

Theory of operation. Any process of the HQ program's host can send datagrams, and they tell nothing but their source. A
port becomes the client's source in two ways only:

- by a 5 between our 4 and its 7 (:meth:`ClientSource.claims_probe`). If a second port sends a 5 too, the session takes
  datagrams of neither;
- after the handshake, while the client has no source, by a packet with its id from the port that deployed programs bind
  (:meth:`ClientSource.claims_late`): a program of 1.3 whose 5 was lost sends 11, 12 and 61 by UDP all the same. If it
  has another source then, one of the two is not the client, and the session takes datagrams of neither any more.

The session calls :meth:`bind` with the first datagram that it is given, and :meth:`lose` when a rival shows up.
"""

from __future__ import annotations

from typing import Any, ClassVar

from gateways.tcpudp.messages import SERVER_ID, ClientUDPConnection, read_header
from gateways.tcpudp.session.packets import Decode, decoders
from zbridge.protocol import Kept, ProtocolError, Role

CLIENT_PORT = 11000
"""The UDP port that deployed HQ programs bind."""
FROM_HQ: dict[int, Decode] = decoders(Role.ROBOT)
"""How to read what an HQ program may send, by packet id."""
_UNASSIGNED = (0, SERVER_ID)
"""The ``id`` bytes that no client is given."""
_NO_HEADER = (-1, -1)
_PROBE = ClientUDPConnection.spec.id


class ClientSource(Kept):
    """The source of one client's datagrams. ``client_port``: the UDP port that it is known to bind; 0: none."""

    kept: ClassVar[dict[str, Any]] = {"bound": bool, "_port": int, "_contested": bool}

    def __init__(self, client_id: int, client_port: int) -> None:
        self.client_port = client_port
        self.bound = False
        """True while datagrams come from a port that is taken for the client's."""
        self._client_id = client_id
        self._port = 0
        self._contested = False
        """True once two ports were taken for the client's after the handshake."""

    def __repr__(self) -> str:
        return f"<ClientSource of {self._client_id}: {self._port if self.bound else 'none'}>"

    def claims_probe(self, datagram: bytes, port: int) -> bool:
        """True for a 5 with the client's id or an unassigned one."""
        sender_id, packet_id = _header(datagram)
        own = sender_id == self._client_id or sender_id in _UNASSIGNED
        return self._claim(port) if own and packet_id == _PROBE else False

    def claims_late(self, datagram: bytes, port: int) -> bool:
        """True for a packet with the client's id from its port, unless that is its source or was contested."""
        if port != self.client_port or self._contested or (self.bound and self._port == port):
            return False
        sender_id, packet_id = _header(datagram)
        return self._claim(port) if sender_id == self._client_id and packet_id in FROM_HQ else False

    def bind(self) -> None:
        """Take the port of the last claim for the client's."""
        self.bound = True

    def lose(self, *, for_good: bool = False) -> None:
        """Have no source; ``for_good``: let none be claimed late."""
        self.bound = False
        self._contested = self._contested or for_good

    def sender_of(self, datagram: bytes) -> int:
        """Give the ``id`` byte of a datagram; -1 if it is no packet."""
        return _header(datagram)[0]

    def may_bear(self, sender_id: int) -> bool:
        """True for the ``id`` bytes of the client's datagrams, and for -1, which decoding will refuse."""
        return sender_id in (_NO_HEADER[0], self._client_id, *_UNASSIGNED)

    def _claim(self, port: int) -> bool:
        if not self.bound:
            self._port = port
        return True


def _header(datagram: bytes) -> tuple[int, int]:
    """Give the ``id`` byte and the packet id of a datagram; -1 each if it is not one packet."""
    try:
        return read_header(datagram)
    except ProtocolError:
        return _NO_HEADER
