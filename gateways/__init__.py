"""One package per protocol; they know the core and nothing of each other."""
