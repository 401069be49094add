"""``pea completion``: what a shell needs to complete the command line.

Exit status: 0 printed, 2 bad input (one line).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

from pea_core.params import ParameterError, nearest

SHELLS = ("bash", "zsh", "fish")


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser("completion", help="completion of the command line in a shell")
    parser.add_argument("shell", metavar="SHELL", help=", ".join(SHELLS))


def _completion(arguments: argparse.Namespace) -> int:
    shell = arguments.shell
    if shell not in SHELLS:
        raise ParameterError(f"completion: unknown shell {shell!r}: {nearest(shell, SHELLS)}")
    import shtab

    from pea_cli.cli import parser

    print(shtab.complete(parser(), shell))
    return 0


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {"completion": _completion}
