"""A rover and ground stations that judge a gateway by the page ``mavlink.md`` (:mod:`zbridge.simulation.judge`)."""
