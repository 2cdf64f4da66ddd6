"""``python -m zbridge.bus.zenoh.try_open SETTINGS``: joins a bus once, and prints Zenoh's own log of it."""

from __future__ import annotations

import sys

import msgspec
import zenoh

from zbridge.bus.interface import BusSettings
from zbridge.bus.zenoh.opening import zenoh_config

if __name__ == "__main__":
    zenoh.init_log_from_env_or("error")
    try:
        with zenoh.open(zenoh_config(msgspec.json.decode(sys.argv[1], type=BusSettings))):
            pass
    except zenoh.ZError as error:
        print(error)  # noqa: T201
