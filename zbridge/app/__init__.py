"""One process: its configuration, the gateway made of it, templates of configurations, counters for Prometheus.

Puts the rooms below together. Knows no protocol (they are found by their entry points) and no terminal; only
:mod:`zbridge.cli` imports it.
"""

from zbridge.app.config import Plan, load, plan
from zbridge.app.gateway import Gateway
from zbridge.app.tasks import until_signal
from zbridge.app.templates import listener_template, robot_template

__all__ = ["Gateway", "Plan", "listener_template", "load", "plan", "robot_template", "until_signal"]
