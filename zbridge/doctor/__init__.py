"""Examines the path from a program to a robot layer by layer, and says what is wrong and what to do.

``findings`` is what is reported. ``robot`` judges what gateways publish; ``bus`` opens the bus and asks, ``here``
examines files, ports and processes of this machine. ``examination`` runs the checks in order: a check that depends on a
failed one is skipped, and says so. No robot is contacted, unless somebody asks for a probe.
"""
