"""One process: its configuration, the gateway made of it, and its counters for Prometheus."""
