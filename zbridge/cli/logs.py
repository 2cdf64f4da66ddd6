"""Sets up the log of a process, on stderr: its form, its level, and that faults of any kind come in that form."""

from __future__ import annotations

import logging
import os
import sys
import threading
from types import TracebackType
from typing import Any

import msgspec

from zbridge.app.config import LogSettings
from zbridge.cli.log_folding import LogHandler
from zbridge.cli.log_lines import JsonFormatter, LineFormatter
from zbridge.errors import ConfigError, describe
from zbridge.fleet.printable import shown
from zbridge.log import Log

FORMAT_VARIABLE = "ZBRIDGE_LOG_FORMAT"
"""The environment variable with the form of the log where no file says it."""
FORMATS = ("console", "json")

log = Log("zbridge.cli")


def set_up_log(
    *,
    verbose: bool = False,
    level: int = logging.INFO,
    robot: str = "",
    labelled: bool = False,
    settings: LogSettings | None = None,
) -> None:
    """Log to stderr; may be called again when more is known.

    settings: form and level, as far as a file says them; else the environment says the form, and ``level`` the level.
    verbose: log every frame. robot: whose log this is; labelled: its name is in every line for people too.
    Raise ConfigError if the environment asks for a form that is none.
    """
    settings = settings or LogSettings()
    is_json = (settings.format or _format_asked()) == "json"
    if settings.level is not None:
        level = logging.getLevelNamesMapping()[settings.level.upper()]
    root, handler = logging.getLogger(), _handler()
    if handler is None:
        if root.handlers:  # of the program that this runs in
            return
        handler = LogHandler()
        root.addHandler(handler)
    root.setLevel(logging.DEBUG if verbose else level)
    handler.robot = robot
    handler.setFormatter(JsonFormatter() if is_json else LineFormatter(f"{robot}: " if robot and labelled else ""))
    logging.captureWarnings(is_json)
    sys.excepthook = _log_uncaught if is_json else sys.__excepthook__
    threading.excepthook = _log_uncaught_in_thread if is_json else threading.__excepthook__
    sys.unraisablehook = _log_unraisable if is_json else sys.__unraisablehook__


def log_settings(form: str, level: str) -> LogSettings:
    """Make settings of words that another process sent; unknown ones are as if not said."""
    try:
        return msgspec.convert({"format": form or None, "level": level or None}, LogSettings)
    except msgspec.ValidationError:
        return LogSettings()


def last_words(code: int, text: object) -> str:
    """Return the line that says why the process ends with an exit code."""
    handler = _handler()
    is_json = isinstance(handler.formatter, JsonFormatter) if handler else os.environ.get(FORMAT_VARIABLE) == "json"
    if not is_json:
        return f"zbridge: {shown(text)}"
    record = log.record(logging.ERROR, "gave_up", "{reason}", reason=text, code=code)
    record.__dict__["robot"] = handler.robot if handler else ""
    return JsonFormatter().format(record)


def _format_asked() -> str:
    form = os.environ.get(FORMAT_VARIABLE) or FORMATS[0]
    if form not in FORMATS:
        raise ConfigError(f"{FORMAT_VARIABLE} = {form!r}: expected {' or '.join(FORMATS)}")
    return form


def _handler() -> LogHandler | None:
    return next((each for each in logging.getLogger().handlers if isinstance(each, LogHandler)), None)


def _log_uncaught(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
    log.log(logging.CRITICAL, "uncaught", "{error}", error=describe(error), exc_info=error)


def _log_uncaught_in_thread(args: threading.ExceptHookArgs) -> None:
    if args.exc_value is not None and args.exc_type is not SystemExit:
        log.log(logging.CRITICAL, "uncaught", "{error}", error=describe(args.exc_value), exc_info=args.exc_value)


def _log_unraisable(args: Any) -> None:
    error = args.exc_value
    if error is not None:
        log.error("unraisable", "{where}: {error}", where=repr(args.object), error=describe(error), exc_info=error)
