"""The bounded worlds that are searched. What is not in any of them is said in ``docs/reliability.md``."""

from tests.search.moves import Bounds
from tests.search.world import Program

ANN, BOB = Program("ann"), Program("bob")
LISTENER = Program("hq.l.1", waits=False)
CHIEF = Program("chief", takeover=True)
ELDER = Program("elder", priority=1)

WORLDS = (
    Bounds("a lease, one client", (ANN,), channel=2, faults=frozenset({"stop", "token", "gateway"})),
)
