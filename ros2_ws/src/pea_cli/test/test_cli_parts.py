"""What a command imports, and where it is found."""

import re
import subprocess
import sys
from itertools import chain
from pathlib import Path

import pytest

import pea_cli
from pea_cli.cli import PARTS, modules

COMMANDS = list(chain(*PARTS.values()))


def test_every_command_stands_with_its_module():
    for name, commands in PARTS.items():
        (part,) = modules(commands[0])
        assert part.__name__ == f"pea_cli.{name}"
        assert set(part.COMMANDS) == set(commands)
    assert len(COMMANDS) == len(set(COMMANDS))
    assert len(modules()) == len(modules("no_command")) == len(PARTS)


def test_no_module_with_commands_is_left_out():
    files = Path(pea_cli.__file__).parent.glob("*.py")
    found = {path.stem for path in files if re.search(r"^COMMANDS\b", path.read_text(), re.M)}
    assert found == set(PARTS)


@pytest.mark.parametrize("typed", ["--version", "node", "completion"])
def test_a_command_imports_no_other(typed):
    """A parser of all commands costs a second."""
    seen = (
        "import sys; from pea_cli.cli import parser; parser(sys.argv[1]);"
        "print(*sorted(m for m in sys.modules if m.startswith(('pea_cli.', 'pea_experiment'))))"
    )
    found = subprocess.run([sys.executable, "-c", seen, typed], capture_output=True, text=True)
    own = [f"pea_cli.{name}" for name, commands in PARTS.items() if typed in commands]
    assert found.stdout.split() == sorted(["pea_cli.cli", *own])
