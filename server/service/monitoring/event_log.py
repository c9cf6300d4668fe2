"""Server log: one line per event, as JSON for programs or as text for people."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import sys
import threading
import traceback
from collections.abc import Iterator
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Any, Literal

LogFormat = Literal["text", "json"]

_about: ContextVar[dict[str, object] | None] = ContextVar("about", default=None)
_KNOWN = {*vars(logging.makeLogRecord({})), "message", "asctime", "taskName", "color_message"}
STAGE_NOTE = "in stage "
TRACEBACK_INDENT = "    "

log = logging.getLogger(__name__)


@contextlib.contextmanager
def about(**facts: object) -> Iterator[None]:
    """Add fields such as `session`, `room` or `address` to all events of this task within the context."""
    token = _about.set({**(_about.get() or {}), **facts})
    try:
        yield
    finally:
        _about.reset(token)


def log_events(log_format: LogFormat) -> None:
    """Log to standard error, from level INFO: events, Python's warnings, and errors that end a thread."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines() if log_format == "json" else TextLines())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.INFO)
    logging.captureWarnings(True)
    threading.excepthook = _log_end_of_thread
    sys.unraisablehook = _log_unraisable


def _log_end_of_thread(ended: threading.ExceptHookArgs) -> None:
    name = "" if ended.thread is None else ended.thread.name
    if ended.exc_value is not None and not isinstance(ended.exc_value, SystemExit):
        log.error("a thread failed", exc_info=ended.exc_value, extra={"of": name})


def _log_unraisable(failed: sys.UnraisableHookArgs) -> None:
    if failed.exc_value is not None:
        log.error("an error could not be raised", exc_info=failed.exc_value, extra={"in": repr(failed.object)})


class JsonLines(logging.Formatter):
    """One JSON object per line: time, level, event, logger, context fields and, for errors, stage and traceback."""

    def format(self, record: logging.LogRecord) -> str:
        """The line; line breaks are escaped."""
        fields: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "event": record.getMessage().rstrip(),
            "logger": record.name,
            **{name: _json_value(value) for name, value in facts_of(record).items()},
        }
        error = record.exc_info[1] if record.exc_info else None
        if error is not None:
            fields["error"] = f"{type(error).__name__}: {error}"
            fields |= stage_of(error)
            fields["traceback"] = "".join(traceback.format_exception(error))
        return json.dumps(fields, default=str)


class TextLines(logging.Formatter):
    """Time, level, event and context fields; an error's traceback follows, indented.

    What clients send can neither begin a line, nor add a field, nor control the terminal.
    """

    def format(self, record: logging.LogRecord) -> str:
        """The line, followed by a traceback if there is one."""
        time = datetime.fromtimestamp(record.created).strftime("%H:%M:%S")
        facts = "".join(f" {name}={_quoted(str(value))}" for name, value in facts_of(record).items())
        line = f"{time} {record.levelname.lower()}: {escaped(record.getMessage().rstrip())}{facts}"
        if not record.exc_info:
            return line
        rest = self.formatException(record.exc_info).split("\n")
        return "\n".join([line, *(f"{TRACEBACK_INDENT}{escaped(text)}" for text in rest)])


def escaped(text: str) -> str:
    """`text` with everything that is not printable (control and format characters, line breaks) as Python escapes."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def _quoted(text: str) -> str:
    """A field's value: in quotes where it could be taken for more than one field."""
    if text and not any(c in text for c in ' ="\\') and text.isprintable():
        return text
    return '"' + escaped(text.replace("\\", "\\\\").replace('"', '\\"')) + '"'


def _json_value(value: object) -> object:
    """JSON has no words for what is not finite."""
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def facts_of(record: logging.LogRecord) -> dict[str, object]:
    """Context fields of the record: those of its task and those passed as `extra`.

    Names that begin with "_" are others' own: Ray puts such on every record of a process that has loaded it.
    """
    extra = {name: value for name, value in vars(record).items() if name not in _KNOWN and not name.startswith("_")}
    return {**(_about.get() or {}), **extra}


def stage_of(error: BaseException) -> dict[str, object]:
    """The innermost pipeline stage in which an error was raised."""
    notes = [note for note in getattr(error, "__notes__", []) if note.startswith(STAGE_NOTE)]
    return {"stage": notes[0].removeprefix(STAGE_NOTE)} if notes else {}
