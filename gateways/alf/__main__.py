"""``python -m gateways.alf FILE``: ``zbridge run`` for this protocol only."""

from zbridge.cli import run_only

run_only("alf")
