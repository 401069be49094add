"""``pea dashboard``: the loop in a browser."""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import socket
from typing import Any

from pea_cli.param import space
from pea_core.config import NAMESPACE
from pea_core.console import out
from pea_core.params import ParameterError, nearest
from pea_core.paths import given
from pea_dashboard.foreign import plain
from pea_record.read import path_and_axis
from pea_ros import graph
from pea_ros.discovery import stay

HOST = "127.0.0.1"
PORT = 8642

TOKEN = "PEA_DASHBOARD_TOKEN"
"""Environment variable with the token, where the dashboard shall not make one."""

LEAST = 16
"""Characters of a token."""


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    shown = commands.add_parser("dashboard", help="watch, tune and stop the loop in a browser")
    what = shown.add_mutually_exclusive_group()
    what.add_argument("--run", metavar="EXPERIMENT", help="start this at once")
    what.add_argument(
        "--attach", action="store_true", help="join the loop that runs in ROS_DOMAIN_ID"
    )
    what.add_argument("--bag", metavar="BAG", help="page through a recording")
    shown.add_argument("--mode", default="composed", help="of --run: composed, distributed")
    shown.add_argument("--clock", default="wall", help="of --run: wall, unpaced (default: wall)")
    shown.add_argument("--rig", metavar="NAME", default="", help="of --run: rig to drive")
    shown.add_argument("--duration", metavar="S", default="60", help="of --run (default: 60)")
    shown.add_argument(
        "--set",
        metavar="NODE.PARAM=VALUE",
        action="append",
        default=[],
        dest="sets",
        help="of --run: change a parameter; may be repeated",
    )
    shown.add_argument("--namespace", default=NAMESPACE, help=f"of the loop (default: {NAMESPACE})")
    shown.add_argument("--axis", metavar="NAME", default="", help="axis to show first")
    shown.add_argument("--host", default=HOST, help=f"address to listen on (default: {HOST})")
    shown.add_argument("--port", default=str(PORT), help=f"and port (default: {PORT})")


def _port(text: str) -> int:
    if not (text.isdecimal() and len(text) <= 5 and 1 <= int(text) <= 65534):
        raise ParameterError(
            f"--port {plain(text)!r}: must be 1 to 65534; the next one is for the stop"
        )
    return int(text)


def _listen(host: str, port: int) -> socket.socket:
    """Listen on a port.

    Raises
    ------
    ParameterError
        It cannot be listened on.
    """
    from pea_dashboard.stop_server import listen

    try:
        return listen(host, port)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ParameterError(
            f"{plain(host)}:{port}: {reason}; give another --host or --port "
            "(the next port is for the stop)"
        ) from None


def _named(host: str) -> str:
    """A host as an address has it; this machine's name where it listens on all."""
    if host in ("0.0.0.0", "::"):
        return socket.gethostname()
    return f"[{host}]" if ":" in host else host


def _token() -> str:
    """The token that the environment gives; empty: none.

    Raises
    ------
    ParameterError
        It is too short, or has characters that do not go into an address and a cookie.
    """
    token = os.environ.get(TOKEN, "")
    if token and not (len(token) >= LEAST and re.fullmatch(r"[A-Za-z0-9._~-]*", token)):
        raise ParameterError(
            f"{TOKEN}: must have {LEAST} characters or more, of letters, digits and - . _ ~"
        )
    return token


def _dashboard(arguments: argparse.Namespace) -> int:
    from pea_dashboard.child import Child, domain, keep_off, plan_of
    from pea_dashboard.door import Door

    port = _port(arguments.port)
    arguments.namespace = space(arguments.namespace)
    door = Door(arguments.host, port, _token())
    with _listen(arguments.host, port + 1) as listening:  # held from here on
        _listen(arguments.host, port).close()
        plan = plan_of(arguments)
        axes = plan.load().axes if arguments.run and arguments.axis else (arguments.axis,)
        if arguments.axis not in axes:
            raise ParameterError(f"--axis {plain(arguments.axis)}: {nearest(arguments.axis, axes)}")
        if arguments.bag and not path_and_axis(given(arguments.bag, "--bag"))[0].exists():
            raise ParameterError(f"--bag {plain(arguments.bag)}: no such recording")
        graph.check_domain()
        if arguments.attach:
            os.environ.setdefault("ROS_DOMAIN_ID", "0")
        number, holder = domain()
        os.environ["ROS_DOMAIN_ID"] = str(number)
        stay(os.environ)
        keep_off()
        child = Child(number, holder)
        _serve(arguments, door, listening, plan, child)
    if child.runs:
        assert child.process is not None
        out.print(
            f"the run goes on: look at it with ROS_DOMAIN_ID={number} pea dashboard --attach, "
            f"end it with kill -INT {child.process.pid}",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
    return 0


def _serve(
    arguments: argparse.Namespace,
    door: Any,
    listening: socket.socket,
    plan: Any,
    child: Any,
) -> None:
    """Serve the page and the stop until Ctrl-C."""
    from pea_dashboard import server, stop_server
    from pea_dashboard.desk import Desk
    from pea_dashboard.door import is_loopback

    bag = arguments.bag or ""
    desk = Desk(child, arguments.attach, bag, plan, arguments.namespace, arguments.axis)
    stopping = stop_server.Server(listening, desk.stop, door)
    with contextlib.closing(desk), stop_server.serving(stopping):
        address = f"http://{_named(door.host)}:{door.port}/"
        out.print(f"dashboard  {address}", highlight=False, markup=False)
        if not is_loopback(door.host):
            out.print(
                f"{door.host} can be reached from other machines, so a token is needed:\n"
                f"           {address}?token={door.token}",
                highlight=False,
                markup=False,
                soft_wrap=True,
            )
        text = f"ROS domain {child.domain}; Ctrl-C ends the dashboard, not the loop"
        out.print(text, highlight=False)
        with contextlib.suppress(KeyboardInterrupt):
            if arguments.run:
                desk.start()
            server.serve(desk, door, stopping.port)


COMMANDS = {"dashboard": _dashboard}
