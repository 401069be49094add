"""The emergency stop: works when everything else is stuck.

It has a ROS context and a node of its own; `stop_server` gives it a thread and a TCP port.
``/pea/plant/stop`` is called until its answer says that the stage has its safe voltage. Where
nobody serves it, or no answer says so in time, the process that drives the plant gets SIGINT: it
ramps down as it ends. A process that does not end is killed; its watchdog ramps down then, and the
stage is not known to be safe. A simulated loop ends in good order.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

from pea_dashboard.foreign import plain
from pea_dashboard.link import STOPPER
from pea_ros.context import loggable
from pea_wire.topics import NAMESPACE

ANSWER = 2.0
"""Seconds that ``/pea/plant/stop`` has to be discovered, and to answer."""

RAMP = 10.0
"""Seconds that the stage has to reach its safe voltage, before its process is ended."""

AGAIN = 0.05
"""Seconds from an answer to the next call."""

END = {"plant": 3.0, "run": 10.0}
"""Seconds that a process has to end when asked, before it is killed."""

ON_THE_WAY = "on the way"
"""Words of an answer that comes before the stage has its safe voltage."""

UNKNOWN = "the stage may not be safe"

ENDED, KILLED, ALIVE = "ended", "killed", "does not end"
"""How `end` has ended a process."""

POLL = 0.02
"""Seconds between two looks whether it has."""


class EmergencyStopped(NamedTuple):
    """What an emergency stop has done.

    Attributes
    ----------
    safe : bool
        Whether the plant has been stopped, as far as can be known.
    text : str
        One line for people.
    answered : bool
        Whether it is the plant's own answer.
    """

    safe: bool
    text: str
    answered: bool = False

    @property
    def reached(self) -> bool:
        """Whether the plant says that the stage has its safe voltage."""
        return self.answered and self.safe and ON_THE_WAY not in self.text


class PlantProcess(NamedTuple):
    """A process that has a plant: its id, and whether it is the plant's node or a whole run."""

    pid: int
    kind: str


def processes(domain: int, namespace: str = NAMESPACE) -> list[PlantProcess]:
    """Processes of this user that have a plant in a ROS domain and namespace."""
    found = []
    for there in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError, ValueError):
            words = (there / "cmdline").read_bytes().decode(errors="replace").split("\0")
            kind = _kind(words)
            if not kind or _namespace(words) != namespace:
                continue
            pairs = (there / "environ").read_bytes().split(b"\0")
            told = dict(pair.split(b"=", 1) for pair in pairs if b"=" in pair)
            if int(told.get(b"ROS_DOMAIN_ID", b"") or 0) == domain:
                found.append(PlantProcess(int(there.name), kind))
    return found


def _kind(words: list[str]) -> str:
    """What a command line is of `END`; empty where it is something else."""
    if any(word.endswith("/pea_plant/plant") for word in words):
        return "plant"
    ours = any(word == "pea_cli.cli" or word.endswith("/pea") for word in words)
    return "run" if ours and "run" in words else ""


def _namespace(words: list[str]) -> str:
    """Namespace that a command line gives to a node."""
    given = [word.partition(":=")[2] for word in words if word.startswith("__ns:=")]
    given += [after for word, after in pairwise(words) if word == "--namespace"]
    given += [word.partition("=")[2] for word in words if word.startswith("--namespace=")]
    given = ["/" + name.strip("/") for name in given]
    return given[-1] if given else NAMESPACE


def end(process: PlantProcess) -> str:
    """End a process: SIGINT, which ramps a device down, then SIGKILL: its watchdog ramps then.

    A run gets SIGINT twice: the second one ends its scoring.

    Returns
    -------
    str
        `ENDED`, `KILLED` or `ALIVE`.
    """
    again = [(signal.SIGINT, ENDED)] if process.kind == "run" else []
    patience = END[process.kind] / (1 + len(again))
    for number, how in ((signal.SIGINT, ENDED), *again, (signal.SIGKILL, KILLED)):
        try:
            os.kill(process.pid, number)
        except ProcessLookupError:
            return ENDED
        limit = time.monotonic() + patience
        while time.monotonic() < limit:
            if not _alive(process.pid):
                return how
            time.sleep(POLL)
    return ALIVE


def _alive(pid: int) -> bool:
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
    return stat.rpartition(")")[2].split()[0] not in "ZX"


class Stop:
    """Stops the plant of a ROS domain and namespace.

    Parameters
    ----------
    domain : int
    namespace : str
    """

    def __init__(self, domain: int, namespace: str = NAMESPACE) -> None:
        self.domain = domain
        self.namespace = namespace
        self.last: EmergencyStopped | None = None
        self.one = threading.Lock()
        self.context = Context()
        rclpy.init(args=loggable(()), context=self.context, domain_id=domain)
        self.node = Node(
            STOPPER,
            namespace=namespace,
            context=self.context,
            use_global_arguments=False,
            start_parameter_services=False,
            enable_rosout=False,
        )
        self.clients = {
            name: self.node.create_client(Trigger, f"plant/{name}")
            for name in ("stop", "reset", "enable")
        }
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def __call__(self) -> EmergencyStopped:
        """Stop the plant, now."""
        with self.one:
            self.last = self._stop()
            return self.last

    def ask(self, name: str) -> EmergencyStopped | None:
        """Call ``reset`` or ``enable`` of the plant; None where nobody serves it."""
        with self.one:
            return self.call(name)

    def _stop(self) -> EmergencyStopped:
        """Call the service until the stage is safe; else end the process that drives it."""
        before = processes(self.domain, self.namespace)
        last = self._settle(expected=bool(before))
        if last is not None and last.reached:
            return last
        if not before:
            if last is None:
                return EmergencyStopped(True, "nothing runs here")
            return EmergencyStopped(False, f"{last.text}; its process is not found; {UNKNOWN}")
        # without the service no device is driven: the run ends whole, and closes its bag
        first = "run" if last is None else "plant"
        chosen = [process for process in before if process.kind == first] or before
        ends = [(process, end(process)) for process in chosen]
        told = [] if last is None else [last.text]
        told += [f"{process.kind} (process {process.pid}) {how}" for process, how in ends]
        failed = last is not None and last.answered and not last.safe
        safe = not failed and all(how == ENDED for _, how in ends)
        return EmergencyStopped(safe, "; ".join([*told, *([] if safe else [UNKNOWN])]))

    def _settle(self, expected: bool) -> EmergencyStopped | None:
        """Call ``stop`` until the stage is at its safe voltage: the last answer.

        Under load a plant that has just started may not be discovered yet: where one is
        `expected`, its service is waited for. None where nobody serves it.
        """
        client = self.clients["stop"]
        limit = time.monotonic() + ANSWER
        while expected and not client.service_is_ready() and time.monotonic() < limit:
            time.sleep(POLL)
        limit = time.monotonic() + RAMP
        last = self.call("stop")
        while last is not None and last.answered and not last.reached:
            if time.monotonic() > limit:
                return last._replace(text=f"{last.text}, after {RAMP:g} s")
            time.sleep(AGAIN)
            last = self.call("stop") or last._replace(answered=False)  # it has ended meanwhile
        return last

    def call(self, name: str) -> EmergencyStopped | None:
        """Call a service of the plant once; None where nobody serves it."""
        client = self.clients[name]
        if not client.service_is_ready():
            return None
        future = client.call_async(Trigger.Request())
        limit = time.monotonic() + ANSWER
        while not future.done() and time.monotonic() < limit:
            self.executor.spin_once(timeout_sec=POLL)
        service = f"{self.namespace.rstrip('/')}/plant/{name}"
        if not future.done():
            client.remove_pending_request(future)
            return EmergencyStopped(False, f"{service} does not answer within {ANSWER:g} s")
        response = future.result()
        return EmergencyStopped(
            bool(response.success), f"{service}: {plain(response.message)}", True
        )

    def close(self) -> None:
        """Leave the graph."""
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)
