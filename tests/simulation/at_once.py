"""``python -m tests.simulation.at_once NAME``: the conformance kit on a clock that jumps, for who waits for its end.

For simulated robots that live by the clock of their event loop, on TCP alone: not for threads, datagrams or Zenoh.
"""

import asyncio
import logging
import sys

from tests.clock import at_once
from zbridge.simulation.check import main

if __name__ == "__main__":
    logging.disable(logging.CRITICAL)
    asyncio.run = at_once
    sys.exit(main(sys.argv[1:]))
