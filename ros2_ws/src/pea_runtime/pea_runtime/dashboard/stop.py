"""The emergency stop: works when everything else is stuck.

It has a thread, a TCP port, a ROS context and a node of its own. First ``/pea/plant/stop`` is
asked, which ramps a device to its safe voltage. Where nobody serves it, or it does not answer in
time, the process that drives the plant is ended by signal: it ramps down as it ends, and its guard
does where it cannot any more. A simulated loop ends in good order.
"""

from __future__ import annotations

import contextlib
import http.server
import json
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

from pea_ros.topics import NAMESPACE
from pea_runtime.dashboard.link import STOPPER

ANSWER = 1.0
"""Seconds that ``/pea/plant/stop`` has to answer."""

END = {"plant": 3.0, "run": 10.0}
"""Seconds that a process has to end when asked, before it is killed."""

ALIVE = "does not end"

POLL = 0.02
"""Seconds between two looks whether it has."""


class Stopped(NamedTuple):
    """What an emergency stop has done.

    Attributes
    ----------
    safe : bool
        Whether the plant has been stopped, as far as can be known.
    text : str
        One line for people.
    """

    safe: bool
    text: str


class Process(NamedTuple):
    """A process that has a plant: its id, and whether it is the plant's node or a whole run."""

    pid: int
    kind: str


def processes(domain: int) -> list[Process]:
    """Processes of this user that have a plant in a ROS domain."""
    found = []
    for there in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError, ValueError):
            words = (there / "cmdline").read_bytes().decode(errors="replace").split("\0")
            kind = _kind(words)
            if not kind:
                continue
            pairs = (there / "environ").read_bytes().split(b"\0")
            told = dict(pair.split(b"=", 1) for pair in pairs if b"=" in pair)
            if int(told.get(b"ROS_DOMAIN_ID", b"") or 0) == domain:
                found.append(Process(int(there.name), kind))
    return found


def _kind(words: list[str]) -> str:
    """What a command line is of `END`; empty where it is something else."""
    if any(word.endswith("/pea_plant/plant") for word in words):
        return "plant"
    ours = any(word == "pea_runtime.cli" or word.endswith("/pea") for word in words)
    return "run" if ours and "run" in words else ""


def end(process: Process) -> str:
    """End a process: SIGINT, which ramps a device down, then SIGKILL, which leaves it to the guard.

    Returns
    -------
    str
        How it ended.
    """
    patience = END[process.kind]
    for number, how in ((signal.SIGINT, "ended"), (signal.SIGKILL, "killed")):
        try:
            os.kill(process.pid, number)
        except ProcessLookupError:
            return "ended"
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
    """Stops the plant of a ROS domain.

    Parameters
    ----------
    domain : int
        The ROS domain.
    """

    def __init__(self, domain: int) -> None:
        self.domain = domain
        self.last: Stopped | None = None
        self._one = threading.Lock()
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = Node(
            STOPPER,
            namespace=NAMESPACE,
            context=self.context,
            use_global_arguments=False,
            start_parameter_services=False,
            enable_rosout=False,
        )
        self.clients = {
            name: self.node.create_client(Trigger, f"{NAMESPACE}/plant/{name}")
            for name in ("stop", "reset", "enable")
        }
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def __call__(self) -> Stopped:
        """Stop the plant, now."""
        with self._one:
            answered = self._ask("stop")
            if answered is not None and answered.safe:
                self.last = answered
                return answered
            there = processes(self.domain)
            # without the service no device is driven: the run ends whole, and closes its bag
            first = "run" if answered is None else "plant"
            chosen = [p for p in there if p.kind == first] or there
            ends = [(process, end(process)) for process in chosen]
            told = [f"{process.kind} (process {process.pid}) {how}" for process, how in ends]
            if answered is not None:
                told.insert(0, answered.text)
            if not ends:
                told.append("nothing runs here" if answered is None else "its process is not found")
            safe = all(how != ALIVE for _, how in ends) and (answered is None or bool(ends))
            self.last = Stopped(safe, "; ".join(told))
            return self.last

    def ask(self, name: str) -> Stopped | None:
        """Call ``reset`` or ``enable`` of the plant; None where nobody serves it."""
        with self._one:
            return self._ask(name)

    def _ask(self, name: str) -> Stopped | None:
        client = self.clients[name]
        if not client.service_is_ready():
            return None
        future = client.call_async(Trigger.Request())
        limit = time.monotonic() + ANSWER
        while not future.done() and time.monotonic() < limit:
            self.executor.spin_once(timeout_sec=POLL)
        service = f"{NAMESPACE}/plant/{name}"
        if not future.done():
            client.remove_pending_request(future)
            return Stopped(False, f"{service} does not answer within {ANSWER:g} s")
        response = future.result()
        text = f": {response.message}" if response.message else ""
        return Stopped(bool(response.success), f"{service} has answered{text}")

    def close(self) -> None:
        """Leave the graph."""
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


class _Handler(http.server.BaseHTTPRequestHandler):
    """``POST /stop``, and nothing else."""

    server: Server
    protocol_version = "HTTP/1.1"
    timeout = 10.0

    def do_POST(self) -> None:
        length = int(self.headers.get("Content-Length") or 0)
        self.rfile.read(min(length, 1024))
        if self.path != "/stop":
            self._answer(404, {"safe": False, "text": "POST /stop"})
        elif not self.server.allowed(dict(self.headers.items())):
            self._answer(403, {"safe": False, "text": "refused: another page, or no token"})
        else:
            self._answer(200, self.server.stop()._asdict())

    def _answer(self, status: int, body: dict[str, Any]) -> None:
        data = json.dumps(body).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(data)))
        if origin := self.headers.get("Origin"):
            self.send_header("Access-Control-Allow-Origin", origin)
            self.send_header("Access-Control-Allow-Credentials", "true")
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *arguments: Any) -> None:
        pass


class Server(http.server.ThreadingHTTPServer):
    """Serves the emergency stop.

    Parameters
    ----------
    host : str
    port : int
        0: any.
    stop : callable
    allowed : callable
        Whether a request with such headers may stop.
    """

    daemon_threads = True

    def __init__(
        self,
        host: str,
        port: int,
        stop: Callable[[], Stopped],
        allowed: Callable[[dict[str, str]], bool],
    ) -> None:
        self.stop = stop
        self.allowed = allowed
        if ":" in host:
            self.address_family = socket.AF_INET6
        super().__init__((host, port), _Handler)


@contextlib.contextmanager
def serving(server: Server) -> Iterator[None]:
    """Serve in a thread."""
    thread = threading.Thread(target=server.serve_forever, name="stop", daemon=True)
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
