"""``pea bridge``: the running loop for other control systems.

Exit status: 2 bad input (one line), 130 interrupted.
"""

from __future__ import annotations

import argparse
import contextlib
import ipaddress
import os
import re
import signal
from collections.abc import Callable, Coroutine
from typing import Any

from pea_cli.param import space
from pea_core.config import NAMESPACE
from pea_core.console import out
from pea_core.params import ParameterError, nearest
from pea_core.printable import printable

KINDS = ("epics",)


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser("bridge", help="the running loop as an EPICS soft IOC")
    parser.add_argument("kind", metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--prefix", default="PEA:", help="prefix of names (default: PEA:)")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on")
    parser.add_argument("--namespace", default=NAMESPACE, help=f"of the loop (else {NAMESPACE})")


def _bridge(arguments: argparse.Namespace) -> int:
    if arguments.kind not in KINDS:
        raise ParameterError(f"bridge: unknown kind {arguments.kind!r}: {nearest('', KINDS)}")
    prefix = arguments.prefix
    if not re.fullmatch(r"[A-Za-z0-9_:\-]{0,30}", prefix):
        raise ParameterError(f"--prefix {printable(prefix, 30)!r}: letters, digits, _, - and :")
    try:
        host = str(ipaddress.ip_address(arguments.host))
    except ValueError:
        raise ParameterError(
            f"--host {printable(arguments.host, 30)!r}: must be an address of this machine, "
            "as 127.0.0.1"
        ) from None
    namespace = space(arguments.namespace)
    import asyncio

    from pea_dashboard.epics import Ioc
    from pea_dashboard.epics_desk import GraphDesk
    from pea_ros import graph
    from pea_ros.discovery import stay

    stay(os.environ)
    graph.check_domain()
    desk = GraphDesk(int(os.environ.get("ROS_DOMAIN_ID", "0")), namespace)
    try:
        ioc = Ioc(desk, prefix)
        out.print(
            f"{len(ioc.variables)} process variables, {prefix}Y and so on, at {host}; "
            "Ctrl-C ends it",
            highlight=False,
            markup=False,
        )
        asyncio.run(_until_signal(ioc.serve(host)))
    finally:
        desk.close()
    return 130


async def _until_signal(served: Coroutine[None, None, None]) -> None:
    """Serve until SIGINT or SIGTERM."""
    import asyncio

    task = asyncio.ensure_future(served)
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, task.cancel)
    with contextlib.suppress(asyncio.CancelledError):
        await task


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {"bridge": _bridge}
