"""Deterministic simulation of whole gateways: one process, one heap of events, one seed. See reliability.md."""
