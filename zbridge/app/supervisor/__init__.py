"""``zbridge run DIR``: a supervisor, its fork server, and the gateway processes that it keeps running.

Knows no protocol and opens no bus. ``supervisor`` keeps one ``runner`` a robot, which holds a ``process``; ``launch``
has it forked, ``forks`` asks the ``fork_server``. ``child`` is what a gateway process tells over its ``post``, in
``messages``, and writes to shared ``memory``; what it left when it died is its ``deposit``: ``duplicates`` of sockets,
over which its robot is stopped, and the state that ``succession`` offers to the next process. ``heart`` and
``back_off`` decide what counts as hung and when to start again; ``files`` follow the robot files, ``installation``
the code; ``replacement`` puts the installed code in the supervisor's place, which goes on by its ``state``; ``notify``
tells systemd.
"""
