"""Finds out why a router was not reached, by a handshake of our own after Zenoh's failed.

Zenoh's client reports "Unable to connect" whatever the cause. Python's ``ssl`` makes the handshake with the same files,
on a thread of its own, within :data:`LONGEST_S`. In TLS 1.3 a server rejects a client's certificate only after the
handshake, so one read follows.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
import threading
import time
from collections.abc import Callable

import msgspec

from zbridge.bus.interface import BusSettings, Tls
from zbridge.bus.tls.certificate import Certificate
from zbridge.bus.tls.files import client_context, out_of_date, own_certificate, unusable, utc_now
from zbridge.errors import ConfigError
from zbridge.tasks import occurs

LONGEST_S = 3.0
"""Longest time to find the cause, seconds."""
_HANDSHAKE_S = 1.8
"""Longest time for the handshake, seconds; the rest is for identifying a server that does not speak TLS."""
_PLAIN_S = 0.5
"""Longest time until a router of plain TCP closes a connection that sends garbage, seconds."""
_MOST = 4
"""Most endpoints that are tried."""
_NO_MESSAGE = b"\x16\x03\x03\x04\x00".ljust(2 + 0x0316, b"\xff")
"""In plain TCP a whole Zenoh frame (its length, 0x0316, comes first) that is no message: the router disconnects. In TLS
the beginning of a record of 0x0400 bytes: the server waits for the rest."""


class ConnectFault(msgspec.Struct, frozen=True):
    """Why a router was not reached. refused: retrying soon is useless; otherwise the router may just be away."""

    text: str
    refused: bool = True


async def why_not(settings: BusSettings, *, ask: bool = True) -> ConnectFault | None:
    """Return why none of the endpoints could be connected to; None if nothing is found to be wrong.

    ask: connect to them; otherwise only our own files are checked. A silent connection costs a router time.
    """
    local = own_fault(settings.tls)
    if local is not None:
        return ConnectFault(local)
    if not ask:
        return None
    endpoints = settings.connect[:_MOST]
    findings = await asyncio.gather(*(_on_thread(ask_endpoint, at, settings.tls) for at in endpoints))
    found = [each for each in findings if each is not None]
    if not found:
        return None
    return ConnectFault("; ".join(dict.fromkeys(each.text for each in found)), any(each.refused for each in found))


def own_fault(tls: Tls | None) -> str | None:
    """Return what is wrong with our own files; None if nothing is."""
    if tls is None:
        return None
    try:
        certificate = own_certificate(tls)
    except ConfigError as error:
        return str(error)
    return unusable(tls) or (out_of_date(certificate, utc_now()) if certificate is not None else None)


def ask_endpoint(endpoint: str, tls: Tls | None) -> ConnectFault | None:
    """Connect to an endpoint; return why it accepts no connection, None if it seems to."""
    kind, _, address = endpoint.partition("/")
    host, _, port = address.partition("#")[0].partition("?")[0].rpartition(":")
    if kind not in ("tcp", "tls") or not port.isdigit():
        return None
    at, deadline = f"{host}:{port}", time.monotonic() + LONGEST_S
    host = host.strip("[]")
    try:
        if kind == "tcp" and _is_plain(host, int(port), deadline):
            return None
        with socket.create_connection((host, int(port)), _left(deadline)) as link:
            finding = _shake_hands(link, at, host, tls, kind, deadline)
        if finding is not None or kind == "tcp":
            return finding
        if _is_plain(host, int(port), deadline):
            return ConnectFault(f"{at} speaks no TLS: plain TCP (tcp/{at}), or no router at all")
        return ConnectFault(
            f"{at} does not answer in TLS: a router with much to do, or no router at all", refused=False
        )
    except ConnectionRefusedError:
        return ConnectFault(f"nobody listens at {at}", refused=False)
    except socket.gaierror:
        return ConnectFault(f"no host has the name {host}", refused=False)
    except TimeoutError:
        return ConnectFault(f"{at} does not answer", refused=False)
    except OSError as error:
        return ConnectFault(f"{at} cannot be reached: {error.strerror or error}", refused=False)


def _shake_hands(
    link: socket.socket, at: str, host: str, tls: Tls | None, kind: str, deadline: float
) -> ConnectFault | None:
    """Shake hands, and return why that failed or led nowhere; None if the endpoint does not answer in TLS."""
    if tls is not None:
        context, certificate = client_context(tls), own_certificate(tls)
    else:
        context, certificate = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT), None
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    link.settimeout(min(_left(deadline), _HANDSHAKE_S))
    try:
        with context.wrap_socket(link, server_hostname=host) as secure:
            if kind == "tcp":
                return _tls_there(at)
            with contextlib.suppress(TimeoutError):  # nothing comes: the router waits for Zenoh's first message
                secure.settimeout(min(_left(deadline), 1.0))
                secure.recv(1)
            return ConnectFault(f"{at} takes our certificate, but answers nothing", refused=False)
    except ssl.SSLCertVerificationError as error:
        return ConnectFault(_untrusted(error, at, host, tls))
    except ssl.SSLError as error:
        reason = error.reason or ""
        if kind == "tcp" and "ALERT" in reason:
            return _tls_there(at)
        if reason in _NO_TLS or isinstance(error, ssl.SSLEOFError):
            return None
        return ConnectFault(_said_no(reason, at, certificate))
    except (TimeoutError, ConnectionError):
        return None


def _is_plain(host: str, port: int, deadline: float) -> bool:
    """Return whether garbage ends a connection at once, or is answered, as by routers of plain TCP and many others."""
    with socket.create_connection((host, port), _left(deadline)) as link:
        link.settimeout(min(_left(deadline), _PLAIN_S))
        try:
            link.sendall(_NO_MESSAGE)
            link.recv(1)
        except TimeoutError:
            return False
        except ConnectionError:
            pass
    return True


def _tls_there(at: str) -> ConnectFault:
    return ConnectFault(f"{at} speaks TLS: connect to tls/{at} with certificates (--tls FOLDER, bus.tls)")


def _untrusted(error: ssl.SSLCertVerificationError, at: str, host: str, tls: Tls | None) -> str:
    """Return why we do not accept the router's certificate."""
    why = _DISTRUST.get(error.verify_code, f"is not valid: {error.verify_message}")
    return f"the certificate of the router at {at} {why.format(host=host, ca=tls.ca if tls is not None else '')}"


def _said_no(reason: str, at: str, certificate: Certificate | None) -> str:
    """Return why the router does not accept ours."""
    if certificate is None:
        return f"{at} wants a certificate, and we showed none: give --tls FOLDER, or bus.tls with certificate and key"
    why = next((text for part, text in _REFUSALS if part in reason), f"it says {reason.lower().replace('_', ' ')}")
    return f"{at} refused {certificate.common_name or 'our certificate'}: {why}"


_ANOTHER = "is of another authority than {ca}"
_DISTRUST = {
    7: _ANOTHER,
    9: "is not valid yet: is the clock of this machine wrong?",
    10: "has expired",
    18: _ANOTHER,
    19: _ANOTHER,
    20: _ANOTHER,
    21: _ANOTHER,
    26: "is not one of a server: it was issued without --host",
    62: "does not name the host {host}: issue it with --host {host} too, or connect to a host that it names",
    64: "does not name the host {host}: issue it with --host {host} too, or connect to a host that it names",
}
"""By OpenSSL's codes."""
_REFUSALS = (
    ("UNKNOWN_CA", "its certificate is of another authority"),
    ("DECRYPT_ERROR", "its certificate is of another authority"),
    ("CERTIFICATE_EXPIRED", "by the router's clock its certificate has expired, or is not valid yet"),
    ("CERTIFICATE_REQUIRED", "it showed no certificate"),
    ("UNSUPPORTED_CERTIFICATE", "its certificate is not one of a client"),
    ("BAD_CERTIFICATE", "its certificate is not valid"),
)
"""By parts of what OpenSSL calls the router's alert."""
_NO_TLS = ("WRONG_VERSION_NUMBER", "UNEXPECTED_EOF_WHILE_READING", "HTTP_REQUEST", "UNKNOWN_PROTOCOL")


def _left(deadline: float) -> float:
    """Return the seconds that are left, more than 0: a socket without a timeout waits forever."""
    return max(deadline - time.monotonic(), 0.05)


async def _on_thread(
    work: Callable[[str, Tls | None], ConnectFault | None], endpoint: str, tls: Tls | None
) -> ConnectFault | None:
    """Run a blocking call on a thread that may be abandoned; None if it takes too long, or fails itself."""
    loop, done, found = asyncio.get_running_loop(), asyncio.Event(), list[ConnectFault | None]()

    def run() -> None:
        with contextlib.suppress(ConfigError, OSError, ValueError):  # the files have changed meanwhile
            found.append(work(endpoint, tls))
        with contextlib.suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(done.set)

    threading.Thread(target=run, name="zbridge-why-not", daemon=True).start()
    await occurs(done, LONGEST_S + 0.5)
    return found[0] if done.is_set() and found else None
