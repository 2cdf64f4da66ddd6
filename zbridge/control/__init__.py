"""Who may drive one robot: leases, proofs, stops, limits and the audit log.

Knows no link and no protocol; the authority is a machine without clock, loop or bus.
"""
