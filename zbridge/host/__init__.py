"""The gateways of one machine: a supervisor and its processes, or many gateways ``together`` in one process.

Knows no protocol. ``settings`` is ``host.toml``; ``addresses`` refuses a robot address that another gateway of this
machine serves. The supervisor and its fork server open no bus.

``supervisor`` has one ``runner`` per robot, which holds a ``process``; ``forks`` requests it from the ``fork_server``,
which loads the installed code. ``child`` is the gateway's side: it reports over its ``fd_channel``, and writes to
shared ``memory``. What a dead process leaves is its ``deposit``: ``duplicates`` of sockets, over which its robot is
stopped, and the state that ``succession`` offers to the next process. ``watchdog`` decides when a process counts as
hung, and when the next one starts. ``files`` follows the robot files. ``replacement`` executes the installed code in
the supervisor's place, and hands it the supervisor's state.
"""
