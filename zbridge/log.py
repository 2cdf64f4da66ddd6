"""Log events: each has a code for programs, fields, and a sentence for people. Sans-IO.

``log = Log("zbridge.host")``, then ``log.info("next_process", "{robot}: next process in {delay_s:.1f} s", robot="r1",
delay_s=0.5)``. The template names fields by ``str.format``; there may be more fields than it names. ``robot``, ``peer``
and ``session`` name what an event is about: they are keys of their own in a JSON line. Records go to the standard
library's ``logging``, so whatever reads those works; a disabled level costs one look-up.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Mapping
from contextvars import ContextVar

current_robot: ContextVar[str] = ContextVar("current_robot", default="")
"""The robot that the running code serves, in a process that serves several. Tasks and callbacks inherit it."""


class LogMessage:
    """The ``msg`` of a record: a sentence that is formatted when somebody reads it."""

    __slots__ = ("fields", "template")

    def __init__(self, template: str, fields: Mapping[str, object]) -> None:
        self.template = template
        self.fields = fields

    def __str__(self) -> str:
        return self.template.format_map(self.fields)

    def __repr__(self) -> str:
        return f"<LogMessage {self.template!r}>"


class Log:
    """The logger of one name. A call gives an event code in snake_case, the sentence's template, and the fields.

    exc_info: an exception whose traceback follows the sentence.
    """

    __slots__ = ("_logger",)

    def __init__(self, name: str) -> None:
        self._logger = logging.getLogger(name)

    def __repr__(self) -> str:
        return f"<Log {self._logger.name}>"

    def enabled(self, level: int) -> bool:
        """Return whether records of a level are wanted: to skip what would be made for one."""
        return self._logger.isEnabledFor(level)

    def debug(self, event: str, template: str, /, **fields: object) -> None:
        if self._logger.isEnabledFor(logging.DEBUG):
            self._handle(logging.DEBUG, event, template, fields, None)

    def info(self, event: str, template: str, /, **fields: object) -> None:
        if self._logger.isEnabledFor(logging.INFO):
            self._handle(logging.INFO, event, template, fields, None)

    def warning(self, event: str, template: str, /, **fields: object) -> None:
        if self._logger.isEnabledFor(logging.WARNING):
            self._handle(logging.WARNING, event, template, fields, None)

    def error(self, event: str, template: str, /, *, exc_info: BaseException | None = None, **fields: object) -> None:
        if self._logger.isEnabledFor(logging.ERROR):
            self._handle(logging.ERROR, event, template, fields, exc_info)

    def exception(self, event: str, template: str, /, **fields: object) -> None:
        """Log an error with the traceback of the exception that is being handled."""
        if self._logger.isEnabledFor(logging.ERROR):
            self._handle(logging.ERROR, event, template, fields, sys.exc_info()[1])

    def log(
        self, level: int, event: str, template: str, /, *, exc_info: BaseException | None = None, **fields: object
    ) -> None:
        """Log at a level of ``logging``."""
        if self._logger.isEnabledFor(level):
            self._handle(level, event, template, fields, exc_info)

    def record(self, level: int, event: str, template: str, /, **fields: object) -> logging.LogRecord:
        """Make a record that is not handled."""
        return self._record(level, event, template, fields, None)

    def _record(
        self, level: int, event: str, template: str, fields: Mapping[str, object], error: BaseException | None
    ) -> logging.LogRecord:
        exc_info = None if error is None else (type(error), error, error.__traceback__)
        message, name = LogMessage(template, fields), self._logger.name
        record = self._logger.makeRecord(name, level, "", 0, message, (), exc_info)
        record.__dict__.update(event=event, fields=fields)
        return record

    def _handle(
        self, level: int, event: str, template: str, fields: Mapping[str, object], error: BaseException | None
    ) -> None:
        self._logger.handle(self._record(level, event, template, fields, error))
