"""A robot and an HQ program that judge a gateway by the page ``tcpudp.md`` (:mod:`zbridge.simulation.judge`)."""
