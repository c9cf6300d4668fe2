"""What the server writes of what happens: one line an event, as JSON for programs or as text for people."""

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
    """Events of this task while it lasts are about these: `session`, `room`, `address` ..."""
    token = _about.set({**(_about.get() or {}), **facts})
    try:
        yield
    finally:
        _about.reset(token)


def log_events(log_format: LogFormat) -> None:
    """From now on write events to standard error, those of information too."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines() if log_format == "json" else TextLines())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.INFO)


class JsonLines(logging.Formatter):
    """One JSON object a line: time, level, event, where from, what it is about, and of an error what, where and how."""

    def format(self, record: logging.LogRecord) -> str:
        """The line, with nothing in it that ends a line."""
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
    """Time, level, event, what it is about; an error's traceback below."""

    def format(self, record: logging.LogRecord) -> str:
        """The line, and the lines of a traceback."""
        time = datetime.fromtimestamp(record.created).strftime("%H:%M:%S")
        facts = "".join(f" {name}={value}" for name, value in facts_of(record).items())
        line = " ".join(f"{time} {record.levelname.lower()}: {record.getMessage()}{facts}".splitlines())
        return f"{line}\n{self.formatException(record.exc_info)}" if record.exc_info else line


def facts_of(record: logging.LogRecord) -> dict[str, object]:
    """What a record is about: of its task, and what was given as `extra`."""
    extra = {name: value for name, value in vars(record).items() if name not in _KNOWN}
    return {**(_about.get() or {}), **extra}


def stage_of(error: BaseException) -> dict[str, object]:
    """The innermost stage of the pipeline that an error came from."""
    notes = [note for note in getattr(error, "__notes__", []) if note.startswith(STAGE_NOTE)]
    return {"stage": notes[0].removeprefix(STAGE_NOTE)} if notes else {}
