"""What the server says at its start: to a person on the console, as events where the console is a log of JSON."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass

from server.service.monitoring.event_log import LogFormat

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Console:
    """Where lines for the user go."""

    say: Callable[[str], None]
    """Takes one line."""
    shows_token: bool
    """Whether the token may be part of a line."""
    draws: bool = False
    """Whether lines may be a drawing in colours: it is a terminal."""


def console_of(log_format: LogFormat, *, is_token_given: bool) -> Console:
    """Of this process. `is_token_given`: the token is the user's own, not one that the server made up.

    A log of JSON never has the token in it, and nobody needs to be told the token that he gave.
    """
    if log_format == "text":
        return Console(print_line, shows_token=True, draws=sys.stdout.isatty())
    if _is_one_stream():
        return Console(log.info, shows_token=False)
    return Console(print_line, shows_token=not is_token_given)


def print_line(line: str) -> None:
    """On standard output, at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def _is_one_stream() -> bool:
    """Whether standard output goes where the log goes, and that is no terminal."""
    try:
        out, err = os.fstat(sys.stdout.fileno()), os.fstat(sys.stderr.fileno())
        return not sys.stdout.isatty() and os.path.samestat(out, err)
    except (OSError, ValueError):  # one of them is no file
        return False
