"""The command line: ``pea``.

Exit status: 0 done, 2 bad input (one line), 3 the run failed, 130 interrupted.
"""

from __future__ import annotations

if __name__ == "__main__":  # nothing is imported before it is known from where
    from pea_cli import __main__ as first

    raise SystemExit(first.main())

import argparse
import io
import signal
import sys
from collections.abc import Sequence
from concurrent.futures import BrokenExecutor
from importlib import import_module
from types import ModuleType
from typing import NoReturn

from pea_core.console import err, silence
from pea_core.entry import FAILED, line_of
from pea_core.interrupt import INTERRUPT
from pea_core.params import ParameterError
from pea_core.printable import printable
from pea_record.origin import VERSION

BAD_INPUT = 2
"""Exit status where nothing was started."""


PARTS = {
    "list": ("list",),
    "run": ("run",),
    "check": ("check",),
    "decouple": ("decouple",),
    "compare": ("compare",),
    "accept": ("accept",),
    "bag": ("replay", "bag", "diff", "export"),
    "bench": ("bench",),
    "commission": ("commission",),
    "dashboard": ("dashboard",),
    "emulate": ("emulate",),
    "fmu": ("fmu",),
    "identify": ("identify", "simulate-from"),
    "image": ("image",),
    "measure": ("measure",),
    "param": ("param",),
    "report": ("report", "figure"),
    "tune": ("tune",),
    "doctor": ("doctor",),
    "bridge": ("bridge",),
    "new": ("new",),
    "completion": ("completion",),
    "node": ("node",),
}
"""Modules and the commands in each: ``add(commands)`` and ``COMMANDS``. A module is imported when
one of its commands is typed, or all are asked for."""


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        raise ParameterError(f"{message} (see {self.prog} --help)")


def modules(command: str = "") -> list[ModuleType]:
    """Module of a command; all modules where it is no command."""
    found = [name for name, commands in PARTS.items() if command in commands]
    return [import_module(f"pea_cli.{name}") for name in found or PARTS]


def parser(command: str = "") -> argparse.ArgumentParser:
    """Parser of a command and those beside it; of all commands where it is no command."""
    found = _Parser(prog="pea", description="Control of piezoelectric actuators with ROS 2.")
    found.add_argument("--version", action="version", version=f"pea {VERSION}")
    commands = found.add_subparsers(dest="command", metavar="COMMAND", parser_class=_Parser)
    for part in modules(command) if command != "--version" else ():
        part.add(commands)
    return found


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # any name can be shown in any locale
    argv = sys.argv[1:] if argv is None else argv
    typed = argv[0] if argv else ""
    try:
        commandline = parser(typed)
        arguments = commandline.parse_args(argv)
        if arguments.command is None:
            commandline.print_help()
            return 0
        for number in (signal.SIGINT, signal.SIGTERM):  # a script's `&` has SIGINT ignored
            signal.signal(number, INTERRUPT)
        (part,) = modules(arguments.command)
        status: int = part.COMMANDS[arguments.command](arguments)
        return status
    except ParameterError as error:
        err.print(f"pea: {error}")
        return BAD_INPUT
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        silence(sys.stdout)
        return 0
    except BrokenExecutor:
        err.print("pea: a worker process was killed: is there memory enough for all of them?")
        return 3
    except Exception as error:
        line = line_of(error)
        if line is None:
            raise
        silence(sys.stdout)
        err.print(f"pea: {printable(line)}")
        return BAD_INPUT if isinstance(error, ModuleNotFoundError) else FAILED
