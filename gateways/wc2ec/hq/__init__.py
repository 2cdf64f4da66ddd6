"""WC2EC towards external controllers: what they are shown of any robot, and what they command. Sans-IO.

``options`` of a listener, ``client`` is the session of one controller, ``device_table`` the devices it is told of,
``sectors`` make distance sensors of a scan, ``display`` shows values, ``commands`` understands the controllers,
``side`` puts them together. Source: "The gateway as Webots controller" and the dialects of the protocol page.
"""

from gateways.wc2ec.hq.client import HqClient
from gateways.wc2ec.hq.options import HqOptions, Wheels
from gateways.wc2ec.hq.side import Wc2EcHq

__all__ = ["HqClient", "HqOptions", "Wc2EcHq", "Wheels"]
