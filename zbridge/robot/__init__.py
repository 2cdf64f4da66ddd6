"""One robot on the bus: its links, its telemetry, its commands and queries, and which gateway owns it.

Knows no HQ program and no protocol in particular.
"""
