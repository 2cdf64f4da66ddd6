"""Conversations with peers: handshake, versions, pacing, timers, control authority. Sans-IO.

Time is an argument (seconds of a monotonic clock); bytes come in and go out as values. Knows no protocol.
"""
