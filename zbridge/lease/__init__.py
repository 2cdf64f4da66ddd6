"""The lease as programs hold it, and what they share with the gateway: proofs, and the bounds of names and reasons.

Knows no gateway. The lease client is a sans-IO state machine; the lease holder drives it on the bus.
"""
