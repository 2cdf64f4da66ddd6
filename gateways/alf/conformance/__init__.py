"""A vehicle and an HQ program that judge a gateway by the page ``alf.md`` (:mod:`zbridge.simulation.judge`)."""
