"""One gateway process: its configuration, the gateway made of it, templates, counters for Prometheus, restarts.

Combines the packages below. Knows no protocol (entry points find them), no terminal and no other gateway of the host.
"""

from zbridge.app.config import GatewayPlan, load, plan
from zbridge.app.gateway import Gateway
from zbridge.app.templates import addressed, listener_template, robot_template, secured
from zbridge.tasks import until_signal

__all__ = [
    "Gateway",
    "GatewayPlan",
    "addressed",
    "listener_template",
    "load",
    "plan",
    "robot_template",
    "secured",
    "until_signal",
]
