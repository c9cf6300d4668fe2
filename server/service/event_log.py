"""Server log: one line per event, as JSON for programs or as text for people."""

from __future__ import annotations

import contextlib
import json
import logging
import sys
import traceback
from collections.abc import Iterator
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Any, Literal

LogFormat = Literal["text", "json"]

_about: ContextVar[dict[str, object] | None] = ContextVar("about", default=None)
_KNOWN = {*vars(logging.makeLogRecord({})), "message", "asctime", "taskName", "color_message"}
STAGE_NOTE = "in stage "


@contextlib.contextmanager
def about(**facts: object) -> Iterator[None]:
    """Add fields such as `session`, `room` or `address` to all events of this task within the context."""
    token = _about.set({**(_about.get() or {}), **facts})
    try:
        yield
    finally:
        _about.reset(token)


def log_events(log_format: LogFormat) -> None:
    """Log to standard error, from level INFO."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines() if log_format == "json" else TextLines())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.INFO)


class JsonLines(logging.Formatter):
    """One JSON object per line: time, level, event, logger, context fields and, for errors, stage and traceback."""

    def format(self, record: logging.LogRecord) -> str:
        """The line; line breaks are escaped."""
        fields: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "event": record.getMessage(),
            "logger": record.name,
            **facts_of(record),
        }
        error = record.exc_info[1] if record.exc_info else None
        if error is not None:
            fields["error"] = f"{type(error).__name__}: {error}"
            fields |= stage_of(error)
            fields["traceback"] = "".join(traceback.format_exception(error))
        return json.dumps(fields, default=str)


class TextLines(logging.Formatter):
    """Time, level, event and context fields; an error's traceback follows."""

    def format(self, record: logging.LogRecord) -> str:
        """The line, followed by a traceback if there is one."""
        time = datetime.fromtimestamp(record.created).strftime("%H:%M:%S")
        facts = "".join(f" {name}={value}" for name, value in facts_of(record).items())
        line = " ".join(f"{time} {record.levelname.lower()}: {record.getMessage()}{facts}".splitlines())
        return f"{line}\n{self.formatException(record.exc_info)}" if record.exc_info else line


def facts_of(record: logging.LogRecord) -> dict[str, object]:
    """Context fields of the record: those of its task and those passed as `extra`."""
    extra = {name: value for name, value in vars(record).items() if name not in _KNOWN}
    return {**(_about.get() or {}), **extra}


def stage_of(error: BaseException) -> dict[str, object]:
    """The innermost pipeline stage in which an error was raised."""
    notes = [note for note in getattr(error, "__notes__", []) if note.startswith(STAGE_NOTE)]
    return {"stage": notes[0].removeprefix(STAGE_NOTE)} if notes else {}
