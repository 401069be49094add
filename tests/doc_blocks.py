"""Blocks of the docs: commands, Python, files. `test_docs.py` runs the cheap ones.

.ci/env python tests/doc_blocks.py [PAGE ...]      runs those of the pages; by default of all

Lines of a `sh` block run in a shell, in a folder of the page's own, in order. A block with a
`title` is written to that file first. `slow` blocks are left to this command; a `background` one
runs beside the next. A `hand` block is typed by hand, in two shells or with a question; it, and
what asks for hardware, ROS's own tools or a person is parsed only.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
_FENCE = re.compile(r"^```(\w+)([^\n]*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
_INDENTED = re.compile(r"(?:^\n|\A)((?:^    +\S.*\n)+)", re.MULTILINE)
STARTS = ("./pea ", "pea ", ".ci/env ", "make ", "ros2 ")
PLACES = {"BAG": "recorded", "NAME": "simulated_200hz"}
"""What stands for the words that a reader replaces."""

ELSEWHERE = (
    "ros2 ", "make ", "sudo ", "./pea dashboard", "./pea emulate", "./pea accept", "./pea bench",
    "./pea commission", "./pea node", "./pea measure", "./pea param", "./pea simulate-from",
    ".ci/env python",
)  # fmt: skip
"""Starts of lines that need a device, ROS's own tools, a person, a running loop or an hour."""


class Block(NamedTuple):
    """One block: language, words after it, text, line of the page."""

    language: str
    words: str
    text: str
    line: int

    @property
    def title(self) -> str | None:
        """File that the block is."""
        found = re.search(r'title="([^"]+)"', self.words)
        return found and found[1]


def pages() -> list[Path]:
    """Every page: of the site, and those at the root."""
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]


def blocks(page: Path) -> Iterator[Block]:
    """Blocks of a page: fences, and indented ones that begin with a command."""
    text = page.read_text(encoding="utf-8")
    for found in _FENCE.finditer(text):
        yield Block(found[1], found[2], found[3], text[: found.start()].count("\n") + 1)
    bare = _FENCE.sub(lambda m: re.sub(r"[^\n]", "", m[0]), text)
    for found in _INDENTED.finditer(bare):
        lines = [line[4:] for line in found[1].splitlines()]
        if any(line.startswith(STARTS) for line in lines):
            line = bare[: found.start(1)].count("\n") + 1
            yield Block("sh", "", "\n".join(lines) + "\n", line)


def commands(block: Block) -> Iterator[str]:
    """Lines of a `sh` block, joined at backslashes, without comments."""
    joined = block.text.replace("\\\n", " ")
    for line in joined.splitlines():
        words = shlex.split(line, comments=True)
        if words:
            lexer = line if "#" not in line else re.sub(r"\s#(?=\s).*", "", line)
            yield lexer.strip()


def of_pea(command: str) -> list[str] | None:
    """Words after ``pea``, as of the command line; None for another command."""
    for part in re.split(r"&&|;|\|\|?", command):
        words = shlex.split(part)
        while words and (words[0] in ("!", "until") or re.fullmatch(r"[A-Z_]+=.*", words[0])):
            words = words[1:]
        if words and words[0] in ("./pea", "pea"):
            return [word for word in words[1:] if not word.startswith((">", "2>"))]
    return None


def run(page: Path) -> tuple[int, int]:
    """Run the blocks of one page; how many lines ran, how many were only parsed."""
    ran = left = 0
    beside: list[subprocess.Popen] = []
    env = {**os.environ, "PEA_ROOT": str(ROOT)}
    with tempfile.TemporaryDirectory() as place:
        for name in ("pea", ".ci", "config", "docs", "tests", "install", ".venv"):
            (Path(place) / name).symlink_to(ROOT / name)
        made = "./pea run sine_series --duration 0.5 --out recorded"
        if page.parent.name != "tutorials":
            subprocess.run(made, shell=True, cwd=place, check=True, capture_output=True)
        for block in blocks(page):
            if block.title:
                (Path(place) / block.title).write_text(block.text, encoding="utf-8")
            elif block.language == "python":
                subprocess.run(
                    [".ci/env", "python", "-"], input=block.text, text=True, cwd=place, check=True
                )
                ran += 1
            elif block.language == "sh":
                lines = list(commands(block))
                if "hand" in block.words:
                    left += len(lines)
                    continue
                if page.parent.name != "tutorials":
                    left += sum(line.startswith(ELSEWHERE) for line in lines)
                    lines = [line for line in lines if line.startswith("./pea")]
                    lines = [line for line in lines if not line.startswith(ELSEWHERE)]
                    for word, stands in PLACES.items():
                        lines = [re.sub(rf"\b{word}\b", stands, line) for line in lines]
                print(f"{page.relative_to(ROOT)}:{block.line}", *lines, sep="\n    ", flush=True)
                script = "\n".join(lines)
                if "background" in block.words:
                    beside.append(subprocess.Popen(["bash", "-ec", script], cwd=place, env=env))
                    continue
                for line in [script] if page.parent.name == "tutorials" else lines:
                    done = subprocess.run(["bash", "-ec", line], cwd=place, env=env)
                    if done.returncode:
                        raise SystemExit(f"{page}:{block.line}: status {done.returncode}: {line}")
                ran += len(lines)
        for process in beside:
            if process.wait():
                raise SystemExit(f"{page}: what ran beside ended with {process.returncode}")
    return ran, left


if __name__ == "__main__":
    for each in [Path(word).resolve() for word in sys.argv[1:]] or pages():
        done, only = run(each)
        print(f"{each.relative_to(ROOT)}: {done} run, {only} parsed only", flush=True)
