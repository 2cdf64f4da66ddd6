from zbridge.control.authority import Authority
from zbridge.fleet import payload as payloads
from zbridge.fleet.lease_messages import Acquire, Lease
from zbridge.lease.proof import read


def decide(authority: Authority, key: str, payload: bytes, now: float) -> Lease:
    """Answer a question about the lease as the gateway of robot r1 does."""
    name = key.removeprefix("fleet/r1/@rpc/control/")
    if name.startswith("acquire"):
        return authority.acquire(payloads.decode(Acquire, payload), now)
    return (authority.renew if name == "renew" else authority.release)(read(payload), key, now)
