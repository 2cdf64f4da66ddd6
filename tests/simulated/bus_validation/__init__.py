"""The bus model against real Zenoh: the same traces on both, and what each of them did.

``python -m tests.simulated.bus_validation`` prints for each trace what the model allows (the range over many seeds) and
what Zenoh did between network namespaces. What Zenoh did must lie within what the model allows.
"""
