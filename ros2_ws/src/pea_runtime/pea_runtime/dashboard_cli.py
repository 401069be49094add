"""``pea dashboard``: the loop in a browser."""

from __future__ import annotations

import argparse
import contextlib
import os
import socket
from pathlib import Path
from typing import Any

from pea_core.params import ParameterError
from pea_ros.discovery import stay
from pea_runtime import graph
from pea_runtime.console import out

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
    what.add_argument("--bag", metavar="BAG", help="look through a recording")
    shown.add_argument("--mode", default="composed", help="of --run: composed, distributed")
    shown.add_argument("--clock", default="wall", help="of --run: wall, unpaced (default: wall)")
    shown.add_argument("--rig", metavar="NAME", default="", help="of --run: what to drive")
    shown.add_argument("--duration", metavar="S", default="60", help="of --run (default: 60)")
    shown.add_argument(
        "--set",
        metavar="NODE.PARAM=VALUE",
        action="append",
        default=[],
        dest="sets",
        help="of --run: change a parameter; may be repeated",
    )
    shown.add_argument("--host", default=HOST, help=f"address to listen on (default: {HOST})")
    shown.add_argument("--port", default=str(PORT), help=f"and port (default: {PORT})")


def _port(text: str) -> int:
    if not (text.isdecimal() and 1 <= int(text) <= 65534):
        raise ParameterError(f"--port {text!r}: must be 1 to 65534; the next one is for the stop")
    return int(text)


def _free(host: str, port: int) -> None:
    """See that a port can be listened on."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind((host, port))
    except OSError as error:
        raise ParameterError(
            f"{host}:{port}: {error.strerror or error}; give another --host or --port"
        ) from None


def _named(host: str) -> str:
    """A host as an address has it; this machine's name where it listens on all."""
    if host in ("0.0.0.0", "::"):
        return socket.gethostname()
    return f"[{host}]" if ":" in host else host


def _dashboard(arguments: argparse.Namespace) -> int:
    from pea_runtime.dashboard.child import Child, domain, keep_off, plan_of
    from pea_runtime.dashboard.door import Door, is_loopback

    port = _port(arguments.port)
    token = os.environ.get(TOKEN, "")
    if token and len(token) < LEAST:
        raise ParameterError(f"{TOKEN}: must have {LEAST} characters or more")
    for each in (port, port + 1):
        _free(arguments.host, each)
    plan = plan_of(arguments)
    if arguments.bag and not Path(arguments.bag).exists():
        raise ParameterError(f"--bag {arguments.bag}: no such recording")
    graph.check_domain()
    if arguments.attach:
        os.environ.setdefault("ROS_DOMAIN_ID", "0")
    number, holder = domain()
    os.environ["ROS_DOMAIN_ID"] = str(number)
    stay(os.environ)
    keep_off()
    from pea_runtime.dashboard import server
    from pea_runtime.dashboard.desk import Desk

    door = Door(arguments.host, port, token)
    desk = Desk(Child(number, holder), arguments.attach, arguments.bag or "", plan)
    with server.stoppable(desk, door, port + 1) as stop_port:
        address = f"http://{_named(arguments.host)}:{port}/"
        out.print(f"dashboard  {address}", highlight=False, markup=False)
        if not is_loopback(arguments.host):
            out.print(
                f"{arguments.host} can be reached from other machines, so a token is needed:\n"
                f"           {address}?token={door.token}",
                highlight=False,
                markup=False,
                soft_wrap=True,
            )
        out.print(f"ROS domain {number}; Ctrl-C ends the dashboard, not the loop", highlight=False)
        try:
            if arguments.run:
                desk.start()
            with contextlib.suppress(KeyboardInterrupt):
                server.serve(desk, door, port, stop_port)
        finally:
            goes_on = desk.child.runs
            desk.close()
    if goes_on:
        assert desk.child.process is not None
        pid = desk.child.process.pid
        out.print(
            f"the run goes on: look at it with ROS_DOMAIN_ID={number} pea dashboard --attach, "
            f"end it with kill -INT {pid}",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
    return 0


COMMANDS = {"dashboard": _dashboard}
