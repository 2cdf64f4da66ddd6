"""The installed ``zbridge``, and ``python -m zbridge``: Ctrl-C ends it without a traceback, however early it comes."""

from __future__ import annotations

import signal
import sys

INTERRUPTED = 130
"""The exit code after Ctrl-C where nothing has to end in order: 128 and the signal, as shells count."""


def main() -> None:
    """Run the command line."""
    interrupted = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # a background job ignores it
    if interrupted:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # an exception while C modules are loaded may crash them
    from zbridge.cli import main as run

    if interrupted:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        run()
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


if __name__ == "__main__":
    main()
