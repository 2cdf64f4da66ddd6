"""Benchmarks: run by hand, never collected by pytest. ``python -m tests.benchmarks.gateway`` is the one command."""
