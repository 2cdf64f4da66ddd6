"""``python -m zbridge``: the command line."""

from zbridge.cli import main

main()
