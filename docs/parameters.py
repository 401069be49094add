"""The tables of parameters.md, from the blocks themselves.

python docs/parameters.py            writes them
python docs/parameters.py --check    status 1 where they are out of date
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator
from pathlib import Path

from pea_core.config import NODES, NodeParams
from pea_core.params import Choice, Schema, Spec
from pea_experiment.experiment import SCHEMAS

PAGE = Path(__file__).with_name("parameters.md")
MARK = "<!-- from here on written by docs/parameters.py -->\n"
HEAD = "| parameter | {}default | range | meaning |\n|---|---|{}---|---|\n"


def entries(
    schema: Schema, prefix: str = "", of: str = "", kinds: int = 0
) -> Iterator[tuple[str, Spec, str, int]]:
    """Name and `Spec` of every parameter, the type it belongs to, one of so many."""
    if isinstance(schema, Choice):
        yield f"{prefix}type", schema.spec, "", 0
        for kind, params in schema.kinds.items():
            yield from entries(params, prefix, kind, len(schema.kinds))
        return
    for field in dataclasses.fields(schema):
        if "group" in field.metadata:
            yield from entries(field.metadata["group"], f"{prefix}{field.name}.", of, kinds)
        else:
            yield f"{prefix}{field.name}", field.metadata["spec"], of, kinds


def shown(value: object) -> str:
    """Value as in YAML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "[" + ", ".join(shown(item) for item in value) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value) or "''"


def table(schema: Schema) -> str:
    """One row a parameter; alike ones of several types share theirs."""
    owners: dict[tuple[str, Spec, int], list[str]] = {}
    for name, spec, of, kinds in entries(schema):
        owners.setdefault((name, spec, kinds), []).append(of)
    typed = any(kinds for _, _, kinds in owners)
    text = HEAD.format("of type | " if typed else "", "---|" if typed else "")
    for (name, spec, kinds), types in owners.items():
        of = [", ".join(types) if len(types) < kinds else ""] if typed else []
        about = spec.help + ("; fixed while running" if spec.fixed else "")
        cells = [f"`{name}`", *of, shown(spec.default), spec.rule, about]
        text += "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"
    return text


def tables() -> str:
    """What stands below `MARK`."""
    sections = {"Every node": NodeParams, **{node.capitalize(): SCHEMAS[node] for node in NODES}}
    return "".join(f"\n## {title}\n\n{table(schema)}" for title, schema in sections.items())


def main(check: bool) -> int:
    """Write the page or, with `check`, say whether it is up to date."""
    old = PAGE.read_text(encoding="utf-8")
    new = old.partition(MARK)[0] + MARK + tables()
    if not check:
        PAGE.write_text(new, encoding="utf-8")
    elif new != old:
        print(f"{PAGE}: out of date, run docs/parameters.py", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main("--check" in sys.argv[1:]))
