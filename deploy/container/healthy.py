"""The check of the image: whether each gateway answers whose file has ``[metrics]``. Exit code 0 or 1.

Reads files and asks over HTTP; it needs no bus and no certificate, and so little time that it may run often.
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
    """List robot, host and port of each file with an endpoint; of a faulty file the supervisor tells."""
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
    """Whether ``/healthz`` says that the process lives."""
    connection = http.client.HTTPConnection(host, port, timeout=WITHIN_S)
    try:
        connection.request("GET", "/healthz")
        return connection.getresponse().status == http.client.OK
    except (OSError, http.client.HTTPException):
        return False
    finally:
        connection.close()


def main(folder: Path) -> int:
    """Ask all gateways, and name those that do not answer."""
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
