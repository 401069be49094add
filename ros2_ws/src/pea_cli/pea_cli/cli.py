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
from typing import NoReturn

from pea_cli import (
    accept,
    bag,
    bench,
    bridge,
    check,
    commission,
    compare,
    completion,
    dashboard,
    decouple,
    doctor,
    emulate,
    fmu,
    identify,
    image,
    measure,
    new,
    node,
    param,
    report,
    run,
    tune,
)
from pea_cli import list as lists
from pea_core.console import err, silence
from pea_core.entry import FAILED, line_of
from pea_core.interrupt import INTERRUPT
from pea_core.params import ParameterError
from pea_core.printable import printable
from pea_record.origin import VERSION

BAD_INPUT = 2
"""Exit status where nothing was started."""


PARTS = (
    lists,
    run,
    check,
    decouple,
    compare,
    accept,
    bag,
    bench,
    commission,
    dashboard,
    emulate,
    fmu,
    identify,
    image,
    measure,
    param,
    report,
    tune,
    doctor,
    bridge,
    new,
    completion,
    node,
)
"""Modules of the commands: ``add(commands)`` and ``COMMANDS``. They import what is
heavy when a command runs."""


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        raise ParameterError(f"{message} (see {self.prog} --help)")


def parser() -> argparse.ArgumentParser:
    """Parser of the whole command line."""
    found = _Parser(prog="pea", description="Control of piezoelectric actuators with ROS 2.")
    found.add_argument("--version", action="version", version=f"pea {VERSION}")
    commands = found.add_subparsers(dest="command", parser_class=_Parser)
    for part in PARTS:
        part.add(commands)
    return found


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # any name can be shown in any locale
    commandline = parser()
    try:
        arguments = commandline.parse_args(argv)
        if arguments.command is None:
            commandline.print_help()
            return 0
        for number in (signal.SIGINT, signal.SIGTERM):  # a script's `&` has SIGINT ignored
            signal.signal(number, INTERRUPT)
        commands = {name: act for part in PARTS for name, act in part.COMMANDS.items()}
        return commands[arguments.command](arguments)
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
