"""``zbridge run DIR``: a supervisor, its fork server, and the gateway processes that it keeps running.

Knows no protocol and opens no bus. ``supervisor`` keeps one ``runner`` a robot, which holds a ``process``; ``forks``
asks the ``fork_server``; ``child`` is what a gateway process tells over its ``post``, in ``messages``. ``heart`` and
``back_off`` decide what counts as hung and when to start again; ``duplicates`` stop the robot of a process that died;
``files`` follow the robot files, ``installation`` the code; ``replacement`` puts the installed code in the supervisor's
place, which goes on by its ``state``; ``notify`` tells systemd.
"""
