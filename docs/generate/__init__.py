"""What stands in the reference because code declares it: ``python -m docs.generate`` writes it anew.

A page marks where: from ``<!-- generated: NAME -->`` to ``<!-- /generated -->``. ``tests/docs/test_generated.py``
compares the pages with the code.
"""
