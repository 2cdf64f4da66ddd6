"""``python -m gateways.alf FILE``: run the gateway of one ALF vehicle."""

from zbridge.cli import run_only

run_only("alf")
