"""Exhaustive search: every state of a bounded world of the real authority, filters, proofs, latches and lease clients.

``python -m tests.search`` prints what was reached; ``reliability.md`` says what is in a world and what is not.
"""
