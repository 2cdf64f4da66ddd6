"""Who may drive one robot, on the gateway's side: the authority, stops and latches, limits on motion, the audit log.

Knows no link and no protocol. The authority is a sans-IO state machine; the enforcer carries out what it decides; the
lease server answers queries about the lease; admission filters sort commands and queries on the bus's threads.
"""
