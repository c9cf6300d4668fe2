"""The page of the command line, from the program's own declarations."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import typer

from client.cli import app
from client.options.help import FIRST, GROUPS

_PLAIN = str.maketrans({sign: f"&#{ord(sign)};" for sign in "|<>[]*_"})
"""Signs that have a meaning in Markdown."""
HEAD = """\
# The command line

`probeless COMMAND --help` prints the options that people need first (bold here), `--help-all` every option.
Errors are one line on standard error; the exit status is 0, 1 (it could not be done), 2 (wrong use) or 130 (Ctrl-C).
[Options explained](../options.md) says what the choices mean.
"""


def command_line_page() -> str:
    """Markdown of all commands."""
    commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    return "\n".join([HEAD, *(line for name, command in commands.items() for line in _command(name, command))])


def _command(name: str, command: Any) -> Iterator[str]:
    context = typer.Context(command, info_name=name)
    yield f"## probeless {name}\n"
    yield f"{command.help}\n"
    if command.epilog:
        yield f"```sh\n{command.epilog}\n```\n"
    parameters = {parameter.name: parameter for parameter in command.get_params(context) if parameter.name != "help"}
    arguments = [key for key, parameter in parameters.items() if parameter.param_type_name == "argument"]
    grouped = {key for keys in GROUPS.values() for key in keys}
    others = [key for key in parameters if key not in grouped and key not in arguments]
    for title, keys in {"Arguments": arguments, **GROUPS, "Others": others}.items():
        found = [parameters[key] for key in keys if key in parameters]
        rows = [row for parameter in found if (row := _row(parameter, context))]
        if rows:
            yield f"### {title} {{ #{name}-{title.lower().replace(' ', '-')} }}\n\n| option | meaning |\n|---|---|"
            yield from rows
            yield ""


def _row(parameter: Any, context: Any) -> str:
    record = parameter.get_help_record(context)
    if record is None:
        return ""
    names, text = (re.sub(r"\s+", " ", part) for part in record)
    mark = "**" if parameter.name in FIRST else ""
    return f"| {mark}`{names}`{mark} | {text.translate(_PLAIN)} |"
