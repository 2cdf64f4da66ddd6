"""``python -m gateways.wc2ec FILE``: ``zbridge run`` for this protocol only."""

from zbridge.cli import run_only

run_only("wc2ec")
