"""Fuzzing of everything that reads bytes from outside: ``python -m tests.fuzz [TARGET] --seconds N``.

``tests/corpus/<target>/`` has the inputs that are worth keeping; the normal tests replay them. ``reliability.md``
says what holds, and how much of each decoder the corpus reaches.
"""
