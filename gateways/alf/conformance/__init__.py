"""Judges of this protocol: programs as fragile as the deployed ones, and a parser of their own.

Shares no code with the gateway.
"""
