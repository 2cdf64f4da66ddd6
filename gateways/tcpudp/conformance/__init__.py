"""Judges of this protocol: a robot and an HQ program as fragile as the deployed ones, and a parser of their own.

They record each violation of what the protocol page ``tcpudp.md`` demands, and die of what kills or cripples the
deployed programs. They share no code with the gateway, so that an error there cannot hide here: not its messages,
session, settings or translation. Section names in the docstrings are those of that page.
"""
