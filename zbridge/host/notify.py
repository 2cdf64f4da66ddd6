"""Tells systemd how the service is (sd_notify). Does nothing where systemd did not ask for it."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping


class Systemd:
    """The socket that systemd named in the environment. watchdog_s: seconds between signs of life, 0: none wanted."""

    def __init__(self, environment: Mapping[str, str] = os.environ, pid: int | None = None) -> None:
        path = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + path[1:] if path.startswith("@") else path
        mine = environment.get("WATCHDOG_PID") in (None, str(pid or os.getpid()))
        wanted = environment.get("WATCHDOG_USEC", "")
        self.watchdog_s = int(wanted) / 2_000_000 if mine and self._address and wanted.isdecimal() else 0.0

    def __repr__(self) -> str:
        return f"<Systemd {self._address or 'absent'}>"

    def tell(self, *lines: str) -> bool:
        """Send lines such as ``READY=1`` and ``STATUS=8 robots``; False if they found no room."""
        if self._address:
            try:
                with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
                    end.setblocking(False)
                    end.sendto("\n".join(lines).encode(), self._address)
            except OSError:
                return False
        return True
