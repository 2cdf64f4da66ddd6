"""Ground stations as HQ programs: any robot as the ArduRover that they expect. Sans-IO.

``hq`` is one listener, ``session`` one ground station with its own mode and arming, ``commands`` what it may order,
``driving`` its sticks and setpoints, ``vehicle`` what it is told, ``streams`` how often, ``parameters`` and
``answers`` the rest of what they ask for before they are content.
"""
