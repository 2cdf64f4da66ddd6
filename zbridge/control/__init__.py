"""Who may drive one robot: leases, proofs, stops, limits and the audit log.

Knows no link and no protocol. ``authority`` is the gateway's machine, ``lease_client`` the holder's; both are without
clock, loop and bus.
"""
