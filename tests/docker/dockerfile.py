"""Dockerfiles, read as far as the project's own go: one instruction a line."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
KNOWN = {
    "ARG",
    "CMD",
    "COPY",
    "ENTRYPOINT",
    "ENV",
    "EXPOSE",
    "FROM",
    "HEALTHCHECK",
    "RUN",
    "STOPSIGNAL",
    "USER",
    "VOLUME",
    "WORKDIR",
}


@dataclass(frozen=True)
class Image:
    """What a Dockerfile says, in its order."""

    steps: tuple[tuple[str, str], ...]
    """Instruction and the rest of its line."""
    environment: dict[str, str] = field(default_factory=dict)

    def last(self, instruction: str) -> str:
        """Of the instructions of that name, the one that counts. Raises LookupError."""
        found = [rest for name, rest in self.steps if name == instruction]
        if not found:
            raise LookupError(f"there is no {instruction}")
        return found[-1]

    @property
    def health_command(self) -> list[str]:
        """In exec form. Raises ValueError where it is no JSON list."""
        return exec_form(self.last("HEALTHCHECK").partition("CMD ")[2])

    @property
    def command(self) -> list[str]:
        """What a container runs. Raises ValueError where it is not in exec form."""
        return exec_form(self.last("ENTRYPOINT"))


def read_image(path: Path) -> Image:
    """Raises ValueError naming a line that is not understood."""
    steps: list[tuple[str, str]] = []
    environment: dict[str, str] = {}
    for number, line in enumerate(path.read_text().splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        name, _, rest = line.partition(" ")
        if name not in KNOWN or line.endswith("\\"):
            raise ValueError(f"{path.name}, line {number} is not understood: {line}")
        steps.append((name, rest.strip()))
        if name in ("ENV", "ARG"):
            environment |= assigned(rest)
    return Image(tuple(steps), environment)


def exec_form(text: str) -> list[str]:
    """A command written as a JSON list. Raises ValueError."""
    command = json.loads(text)
    if not isinstance(command, list) or not all(isinstance(word, str) for word in command):
        raise ValueError(f"not in exec form, so signals would end at a shell: {text}")
    return command


def assigned(rest: str) -> dict[str, str]:
    """What an ENV or ARG sets."""
    return dict(pair.split("=", 1) for pair in shlex.split(rest))


def copies(rest: str) -> tuple[list[str], str]:
    """Sources and destination of a COPY."""
    *sources, destination = shlex.split(rest)
    return sources, destination


def install_steps(image: Image) -> list[str]:
    """The steps of install.sh that an image takes, in its order."""
    runs = [rest for name, rest in image.steps if name == "RUN"]
    found = [re.fullmatch(r"sh docker/install\.sh (\w+)(?: .*)?", run) for run in runs]
    unknown = [run for run, match in zip(runs, found, strict=True) if match is None]
    if unknown:
        raise ValueError(f"not a step of docker/install.sh: {unknown[0]}")
    return [match.group(1) for match in found if match is not None]
