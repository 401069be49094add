"""``pea new``: a working, tested skeleton in a package of the user's own.

Exit status: 0 made, 2 bad input (one line).
"""

from __future__ import annotations

import argparse
import keyword
import re
from importlib.resources import files
from importlib.resources.abc import Traversable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pea_cli.list import lists
from pea_core.console import out
from pea_core.params import ParameterError, nearest

KINDS = ("law", "observer", "reference", "driver", "experiment", "rig")
TITLES = {"law": "controller"}
"""How `lists` names a kind, where it has another word."""

_MARK = "@NAME@"
_END = ".in"


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser("new", help="a package of your own, with a test")
    parser.add_argument("kind", metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("name", metavar="NAME", help="lower case letters, digits, _")


def _copied(source: Traversable, there: Path, name: str) -> None:
    for each in source.iterdir():
        target = there / each.name.replace(_MARK, name).removesuffix(_END)
        if each.is_dir():
            if each.name != "__pycache__":
                target.mkdir()
                _copied(each, target, name)
        elif each.name.endswith(_END):
            text = each.read_text(encoding="utf-8").replace(_MARK, name)
            target.write_text(text, encoding="utf-8")


def _new(arguments: argparse.Namespace) -> int:
    kind, name = arguments.kind, arguments.name
    if kind not in KINDS:
        raise ParameterError(f"new: unknown kind {kind!r}: {nearest(kind, KINDS)}")
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or keyword.iskeyword(name):
        raise ParameterError(
            f"new: NAME {name!r}: must be lower case letters, digits and _, and begin with a "
            "letter: it is the name of a Python module"
        )
    if name in lists()[f"{TITLES.get(kind, kind)}s"]:
        raise ParameterError(f"new: {kind} {name!r} exists already: give another name")
    if find_spec(name) is not None:
        raise ParameterError(f"new: Python module {name!r} exists already: give another name")
    there = Path(name)
    try:
        there.mkdir()
    except FileExistsError:
        raise ParameterError(f"new: {name} exists already: give another name") from None
    _copied(files("pea_cli") / "skeletons" / kind, there, name)
    out.print(f"made      {there}/", highlight=False, markup=False)
    out.print(f"test it   python -m pytest {there}", highlight=False, markup=False)
    out.print(f"install   python -m pip install -e {there}", highlight=False, markup=False)
    return 0


COMMANDS = {"new": _new}
