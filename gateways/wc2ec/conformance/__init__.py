"""Two controllers that judge a gateway by the page ``wc2ec.md`` (:mod:`zbridge.simulation.judge`)."""
