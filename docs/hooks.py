"""Pages of the site that come from code, and equations as MathML: hooks of `mkdocs.yml`."""

from __future__ import annotations

import argparse
import dataclasses
import html
import inspect
import os
import re
import sys
from collections.abc import Iterator
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File

from pea_core.params import Choice
from pea_experiment.experiment import SCHEMAS
from pea_experiment.meanings import MEANINGS
from pea_wire import topics

_DIRECTIVE = re.compile(r"^( *)\.\. math:: ?(.*(?:\n\1 +\S.*)*)", re.MULTILINE)
_INLINE = re.compile(r'<(span|div) class="arithmatex">(.*?)</\1>', re.DOTALL)
LIBRARY = {
    "pea": "The library by its short name",
    "pea_core.block": "Contract of the blocks",
    "pea_core.loop": "The loop, sample by sample",
    "pea_core.nominal": "The nominal model",
    "pea_core.params": "Parameters: unit, range, meaning",
    "pea_core.signals": "Signals",
    "pea_experiment.experiments": "Experiments",
    "pea_record.frame": "Recordings as tables",
    "pea_lab.sweep": "Sweeps",
}
"""Modules that are written for users of Python, and what each is."""


def blocks() -> Iterator[tuple[str, str, Any]]:
    """Every registered model: its parameter, its type, its module."""

    def choices(schema: Any, name: str) -> Iterator[tuple[str, Choice]]:
        if isinstance(schema, Choice):
            yield name, schema
        elif dataclasses.is_dataclass(schema):
            for field in dataclasses.fields(schema):
                if "group" in field.metadata:
                    yield from choices(field.metadata["group"], f"{name}.{field.name}")

    for node, schema in SCHEMAS.items():
        for name, choice in choices(schema, node):
            for kind, params in choice.kinds.items():
                yield name, kind, sys.modules[params.__module__]


def markdown_of(text: str) -> str:
    """A docstring of a model as Markdown."""
    lines = []
    text = _DIRECTIVE.sub(lambda m: f"$$ {' '.join(m[2].split())} $$", inspect.cleandoc(text))
    for line in text.splitlines():
        heading = re.fullmatch(r"(Inputs|Outputs|State|Parameters)", line)
        lines.append(f"\n**{line}**\n" if heading else re.sub(r"^    (?! )", "", line))
    return "\n".join(lines)


def models_page() -> str:
    """Equations of every model, from the head of its file."""
    text = "# Models and their equations\n\nFrom the head of each model's file.\n"
    last = ""
    for name, kind, module in blocks():
        if name != last:
            text, last = f"{text}\n## {name}\n", name
        text += f"\n### {kind}\n\n`{module.__name__}`\n\n{markdown_of(module.__doc__ or '')}\n"
    return text


def commands_page() -> str:
    """What each command says with ``--help``."""
    os.environ["COLUMNS"] = "90"
    from pea_cli.cli import parser

    def helps(one: argparse.ArgumentParser) -> Iterator[tuple[str, str]]:
        yield one.prog, one.format_help()
        for action in one._actions:
            if isinstance(action, argparse._SubParsersAction):
                for sub in action.choices.values():
                    yield from helps(sub)

    text = "# Command line\n\nExit status: 0 done; 2 bad input, one line; 3 the run failed.\n"
    for name, says in helps(parser()):
        text += f"\n## `{name}`\n\n```text\n{says}```\n"
    return text


def topics_page() -> str:
    """The table of topics."""
    text = "# Table of topics\n\nWhat they mean: [topics](../topics.md).\n\n"
    text += "| topic | type | published by | needed by | history | latched |\n"
    text += "|---|---|---|---|---|---|\n"
    for one in vars(topics).values():
        if isinstance(one, topics.Topic):
            cells = (f"`{one.name}`", f"`{one.type}`", one.publisher or "all nodes")
            more = (", ".join(one.subscribers), str(one.depth), "yes" if one.latched else "")
            text += f"| {' | '.join((*cells, *more))} |\n"
    return text


def metrics_page() -> str:
    """Entries of metrics.json."""
    text = "# Metrics\n\nThe entries of `metrics.json`, and of `pea run --json`.\n\n"
    text += "| key | meaning |\n|---|---|\n"
    return text + "".join(f"| `{key}` | {about} |\n" for key, about in MEANINGS.items())


def library_page() -> str:
    """The modules for users of Python."""
    text = "# Python\n"
    for module, about in LIBRARY.items():
        text += f"\n## {about}: `{module}`\n\n::: {module}\n    options:\n"
        text += "      heading_level: 3\n      show_root_heading: false\n"
        text += "      show_root_toc_entry: false\n"
    return text


PAGES = {
    "reference/models.md": models_page,
    "reference/commands.md": commands_page,
    "reference/topics.md": topics_page,
    "reference/metrics.md": metrics_page,
    "reference/python.md": library_page,
}
"""Page to what writes it."""


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that come from code."""
    for path, page in PAGES.items():
        files.append(File.generated(config, path, content=page()))
    return files


def on_page_markdown(text: str, **_: Any) -> str:
    """Leave out the words for `tests/doc_blocks.py`: with them a fence is no block of the page."""
    return re.sub(r"^```sh(?: (?:slow|background|hand))+$", "```sh", text, flags=re.MULTILINE)


def on_page_content(text: str, **_: Any) -> str:
    """Equations as MathML, which browsers draw without a script."""

    def drawn(found: re.Match[str]) -> str:
        tex = html.unescape(found[2])[2:-2]
        display = "block" if found[1] == "div" else "inline"
        return convert(tex, display=display)

    return _INLINE.sub(drawn, text)


def on_post_page(output: str, **_: Any) -> str:
    """Leave out the one script that the theme would fetch while a page is read."""
    return re.sub(r'<script src="https://[^>]*></script>', "", output)


on_post_template = on_post_page
