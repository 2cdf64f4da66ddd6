"""What the author of a protocol reads: plugin, session, outbox, negotiation, timers and limits. Sans-IO.

Knows no transport, no bus and no robot in particular: bytes, messages and the time come in as arguments.
"""
