"""Recordings of robots as MCAP files: made, looked through, exported, and replayed.

Recording: ``capture`` follows the bus, ``intake`` carries what arrives to the writing thread of ``recorder``,
``contents`` says what each key is in the file, ``tape`` writes, splits and closes. Looking: ``reader`` reads any file,
also one that is cut off or hostile, ``summary`` counts, ``export`` writes tables. Replaying: ``player`` keeps the time,
``replay`` is the robot on the bus, ``wire_robot`` the legacy robot itself. Needs the extra ``zbridge[foxglove]``.
"""
