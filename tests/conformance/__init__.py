"""Cases that every protocol has to pass, written once over the tables ``tests/gateways/<protocol>/golden.py``."""
