"""Judges of this protocol: a Webots controller and an external one, as fragile as the deployed ones, and their parser.

They record each violation of what the protocol page ``wc2ec.md`` demands, and die of what kills or ends the deployed
programs. They share no code with the gateway, so that an error there cannot hide here: not its messages, sessions or
translation. Section names in the docstrings are those of that page.
"""
