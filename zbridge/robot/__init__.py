"""One robot on the bus: its links, its telemetry, its commands and queries, and which gateway owns it.

Knows no HQ program and no protocol in particular. :class:`RobotDevice` puts the parts together; ``commands`` and
``queries`` are the way in, ``telemetry`` and ``presence`` the way out, ``connection`` the links, ``ownership`` keeps
two gateways from serving one robot.
"""
