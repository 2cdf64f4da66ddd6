"""Tests and measurements. What gateways keep over a restart goes to a folder of this process's own."""

import atexit
import os
import shutil
import tempfile
from pathlib import Path

STATE = Path(tempfile.gettempdir()) / f"zbridge-tests-{os.getpid()}"
"""Made by the first gateway that has something to keep."""
os.environ["XDG_STATE_HOME"] = str(STATE)
os.environ.pop("STATE_DIRECTORY", None)
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # hundreds of processes start: each would compile all again
atexit.register(shutil.rmtree, STATE, ignore_errors=True)
