"""Links to peers, and conversations: one session run over one link.

Knows no protocol and no bus.
"""
