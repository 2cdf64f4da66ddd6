"""``python -m gateways.mavlink FILE``: ``zbridge run`` for this protocol only."""

from zbridge.cli import run_only

run_only("mavlink")
