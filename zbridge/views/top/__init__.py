"""``zbridge top``: the robots of a realm on a terminal, redrawn once a second.

``rows`` reads what is shown of a robot, ``columns`` orders and fits it, ``board`` and ``details`` lay out the lines:
all four are plain text and know no terminal. ``app`` and ``screens`` show the lines with Textual, which no other module
imports.
"""
