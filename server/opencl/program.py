"""The one loader of OpenCL programs: real files with their headers, device structs in front, sorted defines, built once
per device."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from threading import Lock

import pyopencl as cl

import cl_kernels
from server.opencl.structs import struct_text

KERNEL_FOLDER = Path(cl_kernels.__file__).parent
_OPTIONS = ("-cl-std=CL1.2", "-Werror", "-cl-fp32-correctly-rounded-divide-sqrt")
PROLOGUE = """#ifdef __clang__
#if __has_warning("-Wpsabi")
#pragma clang diagnostic ignored "-Wpsabi"
#endif
#endif
"""
"""In front of every program. Where a processor has no registers for float16, clang warns that other compilers would
pass it otherwise: no call leaves a program. NVIDIA's compiler is a clang that does not know this warning, which would
be an error."""
_LINE = re.compile(r'#line (\d+) "([^"]+)"')
_UNNAMED = re.compile(r"<kernel>:(\d+):")
_INCLUDE = re.compile(r'#include "([^"]+)"')

# Warnings are errors, so what a compiler says besides tells nobody anything: NVIDIA's, an empty line for each program.
warnings.filterwarnings("ignore", category=cl.CompilerWarning)

Define = int | float | str | bool


class KernelBuildError(RuntimeError):
    """A kernel file does not compile on this device; the message holds file, options and the compiler's log."""


def define_options(defines: dict[str, Define]) -> tuple[str, ...]:
    """Compiler options for `defines`, sorted; floats are written as float literals, True as 1, False is left out."""
    options = []
    for name, value in sorted(defines.items()):
        if value is False:
            continue
        text = f"{float(value)!r}f" if isinstance(value, float) else str(int(value) if value is True else value)
        options.append(f"-D{name}={text}")
    return tuple(options)


def with_headers(text: str, name: str) -> str:
    """The source `text` of the file `name`, with each header in place of its #include line.

    So no compiler option holds the path of this installation, which would be part of the key under which PoCL keeps
    compiled kernels. Compilers name the files all the same. Each header counts once, as with `#pragma once`.
    """
    lines = [f'#line 1 "{name}"']
    for number, line in enumerate(text.splitlines(), 1):
        if found := _INCLUDE.match(line):
            header = found[1]
            guard = f"INCLUDED_{header.replace('.', '_')}"
            whole = with_headers((KERNEL_FOLDER / "include" / header).read_text(), header)
            lines += [f"#ifndef {guard}", f"#define {guard}", whole, "#endif", f'#line {number + 1} "{name}"']
        else:
            lines.append("" if line == "#pragma once" else line)
    return "\n".join(lines) + "\n"


def with_places(message: str, source: str) -> str:
    """A compiler's message with `file:line:` in place of `<kernel>:line:`.

    NVIDIA's compiler counts lines through and passes over what `#line` in the source says of them.
    """
    places, file, number = [], "<kernel>", 0
    for line in source.splitlines():
        number += 1
        places.append(f"{file}:{number}:")
        if found := _LINE.match(line):
            number, file = int(found[1]) - 1, found[2]

    def place(found: re.Match[str]) -> str:
        at = int(found[1]) - 1
        return places[at] if 0 <= at < len(places) else found[0]

    return _UNNAMED.sub(place, message)


class ProgramCache:
    """Programs of one context, keyed by file and defines. Safe to use from several threads."""

    def __init__(self, context: cl.Context) -> None:
        self._context = context
        self._programs: dict[tuple[str, tuple[str, ...]], cl.Program] = {}
        self._lock = Lock()
        device = context.devices[0]
        exact = bool(device.single_fp_config & cl.device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT)
        self._options = [o for o in _OPTIONS if exact or "correctly-rounded" not in o]

    def has(self, file: str, defines: dict[str, Define]) -> bool:
        """Whether the program is built already."""
        return (file, define_options(defines)) in self._programs

    def get(self, file: str, defines: dict[str, Define]) -> cl.Program:
        """The program built from the kernel file of that name with `defines`. Raises KernelBuildError."""
        key = (file, define_options(defines))
        if key in self._programs:  # without the lock, which another thread may hold for as long as it compiles
            return self._programs[key]
        with self._lock:
            if key not in self._programs:
                self._programs[key] = self._build(*key)
            return self._programs[key]

    def _build(self, file: str, defines: tuple[str, ...]) -> cl.Program:
        path = next(KERNEL_FOLDER.rglob(file))  # names are unique over the folders
        source = f"{PROLOGUE}{struct_text()}{with_headers(path.read_text(), file)}"
        options = [*self._options, *defines]
        try:
            program: cl.Program = cl.Program(self._context, source).build(options)
        except cl.RuntimeError as error:
            place = f"cl_kernels/{path.relative_to(KERNEL_FOLDER)}"
            told = with_places(str(error), source)
            raise KernelBuildError(f"{place} with {' '.join(defines) or 'no defines'}: {told}") from error
        return program
