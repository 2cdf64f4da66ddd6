"""The checks of the conformance kit; :mod:`zbridge.simulation.check` runs them in this order.

``package`` the protocol object; ``messages`` and ``examples`` bytes; ``sessions`` handshake, garbage, silence;
``stops`` and ``commands`` what the robot is sent; ``motion``, ``journeys`` and ``bearings`` what the simulated robot
does; ``values`` what is shown of it. ``finding`` is one line of the report, ``stage`` the simulated robot on loopback,
``rehearsal`` the session without a link, ``truth`` compares what is shown with what is so. Knows no protocol.
"""
