"""The gateways of one machine: a supervisor and its processes, or many gateways ``together`` in one process.

Knows no protocol. ``settings`` is ``host.toml``; ``addresses`` refuses a robot address that another gateway of this
machine serves. The supervisor and its fork server open no bus.

``supervisor`` has one ``runner`` per robot, which holds a ``process``; ``launch`` requests it from ``forks``, the
client of the ``fork_server``. ``child`` is the gateway's side: it reports in ``messages`` over its ``fd_channel``, and
writes to shared ``memory``. What a dead process leaves is its ``deposit``: ``duplicates`` of sockets, over which its
robot is stopped, and the state that ``succession`` offers to the next process. ``watchdog`` decides when a process
counts as hung, ``back_off`` when the next one starts. ``files`` follows the robot files, ``installation`` the code;
``replacement`` executes the installed code in the supervisor's place, which resumes from its ``state``; ``notify``
notifies systemd.
"""
