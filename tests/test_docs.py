"""The docs: the site builds without a warning, and its commands and blocks do what they say."""

from __future__ import annotations

import argparse
import ast
import json
import re
import runpy
import shlex
import signal
import subprocess
import sys
import tomllib
from itertools import chain
from pathlib import Path

import pytest
import yaml

from pea_cli.cli import PARTS, main, parser
from pea_controller.model import MODELS as LAWS
from pea_core.params import ParameterError
from pea_observer.model import MODELS as OBSERVERS
from pea_plant.model import creep, hysteresis, load, vibration
from pea_reference.model import MODELS as REFERENCES

sys.path.insert(0, str(Path(__file__).parent))
import doc_blocks
from doc_blocks import DOCS, ROOT, blocks, commands, of_pea, pages

MODELS = {
    "controllers": LAWS,
    "observers": OBSERVERS,
    "references": REFERENCES,
    "plant": {**hysteresis.MODELS, **creep.MODELS, **vibration.MODELS, **load.MODELS},
}
"""Models that a page describes."""


@pytest.fixture(autouse=True)
def handlers():
    """What `main` makes of signals ends with the test."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site, built with warnings as errors: links and anchors are checked by that."""
    there = tmp_path_factory.mktemp("site")
    made = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--site-dir", str(there)],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert made.returncode == 0, made.stdout + made.stderr
    return there


def test_the_site_reads_from_the_disk_alone(site):
    fetched = re.compile(r'<(?:script|link|img|iframe)[^>]+(?:src|href)="?(https?:)?//')
    found = [page for page in site.rglob("*.html") if fetched.search(page.read_text())]
    assert not found
    assert (site / "search/search_index.js").exists()


def test_every_fence_is_a_block_of_its_page(site):
    assert [p.name for p in site.rglob("*.html") if "```" in p.read_text()] == []


def test_equations_are_drawn_without_a_script(site):
    for page in ("explanation/paper.html", "controllers.html", "reference/models.html"):
        text = (site / page).read_text()
        assert "<math" in text
        assert "arithmatex" not in text
        assert ".. math::" not in text


def test_the_reference_has_every_command_topic_and_metric(site):
    text = (site / "reference/commands.html").read_text()
    for name in chain(*PARTS.values()):
        assert f"pea {name}" in text
    assert "/pea/displacement" in (site / "reference/topics.html").read_text()
    assert "rms_error_nm" in (site / "reference/metrics.html").read_text()
    assert "simulate" in (site / "reference/python.html").read_text()


def test_the_tables_of_parameters_are_those_of_the_code():
    assert runpy.run_path(str(DOCS / "parameters.py"))["main"](check=True) == 0


@pytest.mark.parametrize("page", MODELS)
def test_every_model_is_in_the_page_of_its_kind(page):
    text = (DOCS / f"{page}.md").read_text()
    names = {word for code in re.findall(r"`([^`\n]+)`", text) for word in re.findall(r"\w+", code)}
    assert set(MODELS[page]) <= names


def test_the_start_lists_are_lists():
    """Python-Markdown takes a list that touches the paragraph above it for more of it."""
    glued = re.compile(r"^(?! *[-*|#>]|  )[^\n]*[\w:.]\n- ", re.MULTILINE)
    found = {}
    for page in DOCS.rglob("*.md"):
        text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
        lines = [text[: m.start()].count("\n") + 1 for m in glued.finditer(text)]
        lines = [n for n in lines if not _in_list(text.splitlines(), n - 1)]
        if lines:
            found[page.name] = lines
    assert not found


def _in_list(lines: list[str], at: int) -> bool:
    """Whether a line belongs to an entry of a list, or to a table."""
    while at >= 0 and lines[at].strip():
        if re.match(r" *[-*] ", lines[at]):
            return True
        at -= 1
    return False


def test_every_command_of_the_docs_is_one():
    wrong = []
    for page in pages():
        for block in blocks(page):
            for command in commands(block) if block.language == "sh" else ():
                words = of_pea(command)
                if words is None or "..." in words or "…" in words:
                    continue
                try:
                    parser(words[0] if words else "").parse_args(words)
                except ParameterError as error:
                    wrong.append(f"{page.name}:{block.line}: {command}: {error}")
                except SystemExit as ended:  # --help, --version
                    if ended.code:
                        wrong.append(f"{page.name}:{block.line}: {command}")
    assert not wrong, "\n".join(wrong)


def test_every_help_fits_80_columns(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")

    def helps(one):
        yield one.format_help()
        for action in one._actions:
            if isinstance(action, argparse._SubParsersAction):
                for sub in action.choices.values():
                    yield from helps(sub)

    lines = [line for said in helps(parser()) for line in said.splitlines()]
    assert [line for line in lines if len(line) > 80] == []


def test_every_block_is_what_it_says():
    for page in pages():
        for block in blocks(page):
            if block.language == "python":
                ast.parse(block.text)
            elif block.language == "toml":
                tomllib.loads(block.text)
            elif block.language in ("yaml", "yml"):
                yaml.safe_load(block.text)
            elif block.language == "json":
                json.loads(block.text)


def test_links_at_the_root():
    for name in ("README.md", "CONTRIBUTING.md"):
        for link in re.findall(r"\]\(([^)#\s]+)", (ROOT / name).read_text()):
            assert "://" in link or (ROOT / link).exists(), f"{name}: {link}"


@pytest.mark.parametrize("page", sorted((DOCS / "tutorials").glob("*.md")), ids=lambda p: p.stem)
def test_a_tutorial_runs(page, tmp_path, monkeypatch):
    """Its blocks in their order; those marked slow are run by `make docs-slow`."""
    monkeypatch.chdir(tmp_path)
    for block in blocks(page):
        if block.title:
            Path(block.title).write_text(block.text)
        elif "slow" in block.words:
            continue
        elif block.language == "python":
            exec(compile(block.text, str(page), "exec"), {"__name__": "__main__"})
        elif block.language == "sh":
            for command in commands(block):
                words = of_pea(command)
                assert words is not None, f"{command}: not of pea: mark the block slow"
                status = main(words)
                fails = shlex.split(command)[0] == "!"
                assert "|| true" in command or bool(status) == fails, f"{command}: {status}"


def test_the_runner_of_slow_blocks_knows_them(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "text\n\n    ./pea list   # all\n    ./pea run x \\\n      --json\n\n    w = u\n\n"
        '```yaml title="a.yaml"\na: 1\n```\n\n```sh slow\n! ./pea run y\n```\n'
    )
    found = list(blocks(page))
    assert [block.language for block in found] == ["yaml", "sh", "sh"]
    assert found[0].title == "a.yaml"
    assert [of_pea(c) for c in commands(found[2])] == [["list"], ["run", "x", "--json"]]
    assert [of_pea(c) for c in commands(found[1])] == [["run", "y"]]
    assert doc_blocks.PLACES
