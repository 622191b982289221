"""What happens while recordings become rows, for logs: an event has a name and fields, and is one line."""

from __future__ import annotations

import copy
import json
import logging
import math
import sys
import time
from typing import TextIO

from semdb.shown import for_terminal

LOGGER = logging.getLogger("semdb")


def event(name: str, *, level: int = logging.INFO, exc_info: BaseException | None = None, **fields: object) -> None:
    """Logs an event. Fields are numbers, strings, or None; never a URL with its password.

    As text it is one line whatever a field holds, and those of the traceback of `exc_info` where that is given.
    """
    text = " ".join(f"{key}={for_terminal(value)}" for key, value in fields.items())
    LOGGER.log(level, "%s %s", name, text, exc_info=exc_info, extra={"event": name, "fields": fields})


class PlainFormatter(logging.Formatter):
    """As another formatter, but for what is not printable in messages and tracebacks, which no terminal should get."""

    def __init__(self, inner: logging.Formatter | None = None) -> None:
        super().__init__()
        self._inner = inner or logging.Formatter()

    def format(self, record: logging.LogRecord) -> str:
        """The text for `record`: one line, and those of its traceback."""
        plain = copy.copy(record)
        plain.msg, plain.args = for_terminal(record.getMessage()), ()
        if record.exc_info and not record.exc_text:
            plain.exc_text = self._inner.formatException(record.exc_info)
        if plain.exc_text:
            plain.exc_text = "\n".join(map(for_terminal, plain.exc_text.splitlines()))
        return self._inner.format(plain)


class JsonFormatter(logging.Formatter):
    """One JSON object per record: time (UTC), level, logger, event or message, and the fields of an event."""

    def format(self, record: logging.LogRecord) -> str:
        """The line for `record`."""
        line: dict[str, object] = {
            "time": f"{time.strftime('%Y-%m-%dT%H:%M:%S', time.gmtime(record.created))}.{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "logger": record.name,
        }
        if hasattr(record, "event"):
            line["event"] = record.event
            line.update((key, _finite(value)) for key, value in getattr(record, "fields", {}).items())
        else:
            line["message"] = record.getMessage()
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


def _finite(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def log_to(stream: TextIO | None = None) -> None:
    """Writes events as lines of JSON to `stream` (default: stderr) from now on."""
    handler = logging.StreamHandler(stream or sys.stderr)
    handler.setFormatter(JsonFormatter())
    LOGGER.handlers = [handler]
    LOGGER.setLevel(logging.INFO)
    LOGGER.propagate = False
