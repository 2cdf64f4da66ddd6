"""A router in a process of its own: ``python -m tests.benchmarks.router ENDPOINT``."""

from __future__ import annotations

import json
import sys

import zenoh

from tests.benchmarks.peer import hear, tell


def main() -> None:
    """Route until the harness is gone."""
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", json.dumps([sys.argv[1]]))
    with zenoh.open(config):
        tell(ready=True)
        while True:
            hear()


if __name__ == "__main__":
    main()
