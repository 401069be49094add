"""``pea node``: one node, as ``ros2 run`` starts it."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from typing import Any

from pea_core.config import NODES
from pea_core.console import out
from pea_core.params import ParameterError, nearest
from pea_core.printable import printable
from pea_ros import graph
from pea_wire.topics import RECORDER

NODE_HELP = """usage: pea node {node} [--ros-args ARGUMENT ...]

Run the node {node}, as ros2 run does, until Ctrl-C. ARGUMENT is one of ROS:
  --params-file FILE   parameters, for example config/experiments/NAME.yaml
  -p NAME:=VALUE       one parameter; docs/parameters.md lists them
  -r FROM:=TO          another name; -r __ns:=/NAMESPACE another namespace"""


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    node = commands.add_parser("node", help="run one node, as ros2 run does")
    node.add_argument("node", metavar="NODE", help=", ".join((*NODES, RECORDER)))
    node.add_argument("arguments", nargs=argparse.REMAINDER, metavar="...")


def _node(arguments: argparse.Namespace) -> int:
    from pea_run.modes.distributed import executable

    known = (*NODES, RECORDER)
    if arguments.node not in known:
        raise ParameterError(f"unknown node {arguments.node!r}: {nearest(arguments.node, known)}")
    given = arguments.arguments
    if given[:1] in (["-h"], ["--help"]):
        out.print(NODE_HELP.format(node=arguments.node))
        return 0
    if given and given[0] != "--ros-args":
        raise ParameterError(
            f"node {arguments.node}: {printable(given[0], 80)!r}: must begin with --ros-args, "
            f"see pea node {arguments.node} --help"
        )
    graph.check_domain()
    path = executable(arguments.node)
    return os.execv(path, [str(path), *arguments.arguments])


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {"node": _node}
