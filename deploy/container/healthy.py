"""The image's health check: queries each gateway whose file has ``[metrics]``. Exit code 1 if one does not answer.

Reads files and queries over HTTP. It needs no bus and no certificate, and is fast enough to run often.
"""

from __future__ import annotations

import http.client
import sys
import tomllib
from pathlib import Path

ROBOTS = Path("/etc/zbridge/robots")
WITHIN_S = 2.0
EVERYWHERE = {"0.0.0.0": "127.0.0.1", "::": "::1"}


def addresses(folder: Path) -> list[tuple[str, str, int]]:
    """List robot, host and port of each file with an endpoint; skip faulty files, which the supervisor reports."""
    found = []
    for path in sorted(folder.glob("*.toml")):
        try:
            file = tomllib.loads(path.read_text())
            host, _, port = file["metrics"]["listen"].rpartition(":")
            host = host.strip("[]")
            found.append((path.stem, EVERYWHERE.get(host, host), int(port)))
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            continue
    return found


def answers(host: str, port: int) -> bool:
    """Tell whether ``/healthz`` reports a live process."""
    connection = http.client.HTTPConnection(host, port, timeout=WITHIN_S)
    try:
        connection.request("GET", "/healthz")
        return connection.getresponse().status == http.client.OK
    except (OSError, http.client.HTTPException):
        return False
    finally:
        connection.close()


def main(folder: Path) -> int:
    """Query all gateways, print those that do not answer, and return the exit code."""
    asked = addresses(folder)
    silent = [robot for robot, host, port in asked if not answers(host, port)]
    print(
        f"{len(asked) - len(silent)} of {len(asked)} gateways answer",
        *(f"{robot} does not" for robot in silent),
        sep="; ",
    )
    return 1 if silent else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROBOTS))
