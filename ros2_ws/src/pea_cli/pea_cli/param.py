"""``pea param``: parameters of the running nodes, where ros2cli is not installed.

Exit status: 0 done or the same, 2 bad input or refused (one line), 3 different.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from pea_cli.bag import one_line
from pea_cli.options import path_of
from pea_core import config
from pea_core.config import AXIS, NAMESPACE, NODES, spaced
from pea_core.console import err, out
from pea_core.params import ParameterError, Text, nearest, number_of, typed
from pea_core.paths import given

DIFFERENT = 3
"""Exit status if the running nodes differ from the file or experiment."""

UNCOMPARED = ("preset", "changed_by")
"""Parameters that hold the source of values, not values."""


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    params = commands.add_parser("param", help="parameters of the running nodes")
    actions = params.add_subparsers(dest="action", parser_class=type(params))
    get = actions.add_parser("get", help="values of a node")
    get.add_argument("node", metavar="NODE")
    get.add_argument("names", metavar="NAME", nargs="*", help="default: all")
    get.add_argument("--json", action="store_true", help="as JSON")
    sets = actions.add_parser("set", help="set values of a node, all together or none")
    sets.add_argument("node", metavar="NODE")
    sets.add_argument("values", metavar="NAME=VALUE", nargs="+")
    lists = actions.add_parser("list", help="running nodes and their parameters")
    lists.add_argument("node", metavar="NODE", nargs="?")
    lists.add_argument("--json", action="store_true", help="as JSON")
    diff = actions.add_parser("diff", help="compare with a parameter file or an experiment")
    diff.add_argument("source", metavar="FILE|EXPERIMENT")
    diff.add_argument("--node", metavar="NODE", help="only this node")
    diff.add_argument("--json", action="store_true", help="as JSON")
    save = actions.add_parser("save", help="write the values to a new parameter file")
    save.add_argument("file", metavar="FILE", type=path_of, nargs="?", help="else standard output")
    save.add_argument("--node", metavar="NODE", help="only this node")
    load = actions.add_parser("load", help="set the values of a parameter file, node by node")
    load.add_argument("file", metavar="FILE")
    load.add_argument("--node", metavar="NODE", help="only this node")
    for each in (get, sets, lists, diff, save, load):
        each.add_argument(
            "--namespace", metavar="NS", default=NAMESPACE, help=f"of the nodes; else {NAMESPACE}"
        )
    for each in (sets, load):
        each.add_argument(
            "--as", metavar="NAME", dest="author", help="node name recorded with the change"
        )


def space(text: str) -> str:
    """A namespace in ROS's form.

    Raises
    ------
    ParameterError
        It is not a valid namespace.
    """
    return spaced(text, "--namespace")


def role(text: str, namespace: str = NAMESPACE) -> str:
    """Name of a node, as in `NODES`.

    Raises
    ------
    ParameterError
        There is no such node.
    """
    name = text.removeprefix(f"/{namespace.strip('/')}/").removeprefix("/").removeprefix("pea/")
    if name not in NODES:
        raise ParameterError(f"unknown node {text!r}: {nearest(name, NODES)}")
    return name


def assignments(texts: Sequence[str]) -> dict[str, Any]:
    """Values of ``NAME=VALUE``.

    Raises
    ------
    ParameterError
        A text does not have this form, or a name occurs twice.
    """
    values: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise ParameterError(f"{text!r}: write NAME=VALUE")
        if name in values:
            raise ParameterError(f"{name} is given twice")
        parsed = config.parse(value)
        values[name] = (
            [_number(item) for item in parsed] if isinstance(parsed, list) else _number(parsed)
        )
    return values


def _number(value: Any) -> Any:
    number = number_of(value) if isinstance(value, Text) else None
    return value if number is None else number


def author(name: str | None) -> str | None:
    """A valid node name.

    Raises
    ------
    ParameterError
        ROS does not allow this name.
    """
    if name is not None and not re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII):
        raise ParameterError(f"--as {name!r}: give letters, digits and underscores")
    return name


def wanted(source: str, namespace: str = NAMESPACE) -> dict[str, dict[str, Any]]:
    """Values that a parameter file or an experiment has for each node.

    Raises
    ------
    ParameterError
        There is no such file or experiment, or it is not valid.
    """
    from pea_experiment import experiments
    from pea_experiment.experiment import SCHEMAS, SECTION

    if source.endswith((".yaml", ".yml")):
        path = given(source)
        if not path.is_file():
            raise ParameterError(f"{source}: no such file")
        found = config.read(path, (SECTION, *NODES), namespace)
        for node in NODES:
            axes = tuple(found[node].get("axes") or (AXIS,))
            each = []
            for axis in axes:
                own = config.own_of(axes, axis, config.spread(axes, found[node]))
                if own.get("preset"):
                    own |= config.replaced(node, SCHEMAS[node], own, source)
                each.append(own)
            found[node] = config.flat(axes, each)
    else:
        sections = experiments.load_axes(source).sections()
        found = {node: dict(sections[node]) for node in NODES}
    return {
        node: {n: value for n, value in found[node].items() if _compared(n)}
        for node in NODES
        if found[node]
    }


def _compared(name: str) -> bool:
    """Whether a parameter, of one axis or of all, is compared: see `UNCOMPARED`."""
    return name.rpartition(".")[2] not in UNCOMPARED


def differences(running: Mapping[str, Any], asked: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Names whose values differ: running value, requested value; None if one side has none."""
    found = {}
    axes = tuple(running.get("axes") or (AXIS,))
    for name, value in config.spread(axes, asked).items():
        there = running.get(name)
        value = tuple(value) if isinstance(value, list) else typed(there, value)
        try:
            same = there == type(there)(value) if there is not None else False
        except (TypeError, ValueError):
            same = False
        if not same:
            found[name] = (there, value)
    return found


def _client(arguments: argparse.Namespace, name: str | None = None) -> AbstractContextManager[Any]:
    """Who asks the nodes; to somebody at a terminal it says whom it waits for."""
    from pea_ros.param_client import client

    def says(line: str) -> None:
        if err.is_terminal:
            err.print(f"pea: {line}")

    return client(name, arguments.namespace, says)


def _get(arguments: argparse.Namespace) -> int:
    node = role(arguments.node, arguments.namespace)
    with _client(arguments) as nodes:
        values = nodes.get(node, arguments.names)
    if arguments.json:
        print(json.dumps({node: values}), flush=True)
        return 0
    for name, value in values.items():
        told = str(value) if len(values) == 1 else f"{name} = {_text(value)}"
        out.print(told, highlight=False, markup=False)
    return 0


def _set(arguments: argparse.Namespace) -> int:
    node, values = role(arguments.node, arguments.namespace), assignments(arguments.values)
    with _client(arguments, author(arguments.author)) as nodes:
        nodes.set(node, values)
    return 0


def _list(arguments: argparse.Namespace) -> int:
    with _client(arguments) as nodes:
        roles = [role(arguments.node, arguments.namespace)] if arguments.node else nodes.there()
        found = {each: nodes.names(each) for each in roles}
        nobody = nodes.nobody
    if arguments.json:
        print(json.dumps(found), flush=True)
        return 0
    if not found:
        err.print(f"pea: {nobody}")
    for each, names in found.items():
        out.print(
            f"{arguments.namespace}/{each}",
            *(f"  {name}" for name in names),
            sep="\n",
            highlight=False,
        )
    return 0


def _diff(arguments: argparse.Namespace) -> int:
    asked = _only(wanted(arguments.source, arguments.namespace), arguments.node)
    with _client(arguments) as nodes:
        found = {node: differences(nodes.get(node), values) for node, values in asked.items()}
    found = {node: names for node, names in found.items() if names}
    if arguments.json:
        print(json.dumps(found), flush=True)
    elif found:
        table = Table("parameter", "running", arguments.source, box=SIMPLE_HEAD)
        for node, names in found.items():
            for name, values in names.items():
                table.add_row(f"{node}.{name}", *map(_text, values))
        out.print(table)
    else:
        out.print("the same")
    return DIFFERENT if found else 0


def _save(arguments: argparse.Namespace) -> int:
    from pea_experiment.experiment import SCHEMAS

    with _client(arguments) as nodes:
        roles = [role(arguments.node, arguments.namespace)] if arguments.node else nodes.there()
        if not roles:
            raise ParameterError(nodes.nobody)
        values = {each: nodes.get(each) for each in roles}
    sections = {
        each: {
            name: found[name]  # without parameters of the process
            for name in config.specs_of_axes(SCHEMAS[each], found)
            if name in found and _compared(name)
        }
        for each, found in values.items()
    }
    # values saved from another namespace are for any namespace, also for /pea
    anywhere = NAMESPACE if arguments.namespace == NAMESPACE else "/**"
    if arguments.file is None:
        print(config.dump(sections, anywhere), end="", flush=True)
    else:
        with open(arguments.file, "x", encoding="utf-8") as file:
            file.write(config.dump(sections, anywhere))
    return 0


def _load(arguments: argparse.Namespace) -> int:
    asked = _only(wanted(arguments.file, arguments.namespace), arguments.node)
    if not asked:
        raise ParameterError(f"{arguments.file}: has no section for any node")
    with _client(arguments, author(arguments.author)) as nodes:
        for node, values in asked.items():
            new = {n: value for n, (_, value) in differences(nodes.get(node), values).items()}
            if new:
                nodes.set(node, new)
            out.print(f"{arguments.namespace}/{node}: {len(new)} changed", highlight=False)
    return 0


def _only(values: dict[str, dict[str, object]], node: str | None) -> dict[str, dict[str, Any]]:
    if node is None:
        return values
    name = node.rpartition("/")[2] if node.startswith("/") else role(node)
    if name not in values:
        raise ParameterError(f"--node {node}: the file has no section for it")
    return {name: values[name]}


def _text(value: object) -> str:
    if value is None:
        return "-"
    return str(value).lower() if isinstance(value, bool) else str(value)


ACTIONS = {
    "get": _get,
    "set": _set,
    "list": _list,
    "diff": _diff,
    "save": _save,
    "load": _load,
}


def _param(arguments: argparse.Namespace) -> int:
    if arguments.action is None:
        raise ParameterError(f"param: give an action: {', '.join(ACTIONS)}")
    arguments.namespace = space(arguments.namespace)
    return ACTIONS[arguments.action](arguments)


COMMANDS = {"param": one_line(_param)}
