"""One process: its configuration, the gateway made of it, templates of configurations, counters for Prometheus.

Puts the rooms below together. Knows no protocol (they are found by their entry points) and no terminal; only
:mod:`zbridge.cli` imports it. Modules are imported one by one, so that ``zbridge ls`` does not load a gateway:
``config`` (``load``, ``plan``), ``gateway`` (``Gateway``, ``until_signal``), ``templates``, ``prometheus``.
"""
