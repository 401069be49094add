"""What the cross-package tests share: the command line as a process, ROS nodes, bags."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import hashlib
import io
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import rclpy
from ament_index_python.packages import get_package_prefix
from domain_coordinator import domain_id
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from pea_core import config

NODES = ("plant", "observer", "controller", "reference")
RECORDER = "recorder"
PATIENCE = 60.0
"""Seconds until a condition counts as never met, on a machine with other loads."""

THOROUGH = Path(__file__).with_name("thorough.txt")

_PR_SET_PDEATHSIG = 1
_OURS = ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE")


@pytest.hookimpl(tryfirst=True)  # before those are left out that ``-m`` does not choose
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the tests of ``thorough.txt``."""
    lines = THOROUGH.read_text(encoding="utf-8").splitlines()
    files = {item.nodeid.partition("::")[0] for item in items}
    part = any("::" in word for word in config.args) or config.option.keyword or config.option.lf
    for line in lines:
        if line.partition("::")[0] not in files:
            continue
        fitting = [item for item in items if item.nodeid.startswith(line)]
        for item in fitting:
            item.add_marker("thorough")
        if not part and not fitting:
            raise pytest.UsageError(f"{THOROUGH.name}: no test begins with {line}")


def clean_environment(**more: str) -> dict[str, str]:
    """Environment of a user who has set nothing of ROS's discovery."""
    clean = {name: value for name, value in os.environ.items() if name not in _OURS}
    return {**clean, **more}


def until(true: Callable[[], Any], patience: float = PATIENCE) -> Any:
    """Wait for a condition; give what it says at last."""
    end = time.monotonic() + patience
    while not (found := true()) and time.monotonic() < end:
        time.sleep(0.02)
    return found


def text_of(path: Path) -> str:
    return path.read_text(errors="replace") if path.exists() else ""


class Finished(NamedTuple):
    status: int
    out: str
    err: str

    @property
    def metrics(self) -> dict[str, Any]:
        assert self.status == 0, self.err
        return json.loads(self.out)


class Running:
    """A `pea` that runs, with its children.

    Parameters
    ----------
    arguments : sequence of str
        Of the command line.
    there : Path
        Where it runs.
    env : dict
        Its environment.
    drawn : bool
        Whether a run shall draw its report, which takes as long as a short run.
    file_size : int, optional
        No file that it writes can grow beyond so many bytes.
    """

    def __init__(
        self,
        arguments: tuple[str, ...],
        there: Path,
        env: dict[str, str],
        drawn: bool = False,
        file_size: int = resource.RLIM_INFINITY,
    ) -> None:
        def prepare() -> None:
            _die_with_parent()
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_size, file_size))

        if arguments[0] == "run" and not drawn:
            arguments = (*arguments, "--no-report")
        self.there = there
        self.out, self.err = there / "stdout.txt", there / "stderr.txt"
        with open(self.out, "wb") as out, open(self.err, "wb") as err:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "pea_cli.cli", *arguments],
                cwd=there,
                env=env,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=err,
                preexec_fn=prepare,
            )

    def children(self) -> dict[str, int]:
        """Process id of each node that this run has started, by name."""
        found = {}
        tasks = Path(f"/proc/{self.process.pid}/task").glob("*/children")
        for task in tasks:
            with contextlib.suppress(OSError):
                for child in task.read_text().split():
                    words = Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0")
                    for word in words:
                        name = Path(word.decode(errors="replace"))
                        if name.name in (*NODES, RECORDER) and name.parent.parent.name == "lib":
                            found[name.name] = int(child)
        return found

    def crew(self) -> dict[str, int]:
        """The children, once all five are there."""
        until(lambda: len(self.children()) == 5 or self.process.poll() is not None)
        found = self.children()
        assert set(found) == {*NODES, RECORDER}, text_of(self.err)
        return found

    def shared_memory(self) -> set[Path]:
        """Files in shared memory that the nodes have open, and no other process."""
        ours = self.children().values()
        files = {path for pid in ours for path in open_files(pid)}
        for process in Path("/proc").glob("[0-9]*"):
            if int(process.name) not in ours:
                with contextlib.suppress(OSError):
                    files -= open_files(int(process.name))
        return files

    def bag_size(self) -> int:
        return sum(path.stat().st_size for path in self.there.glob("run/*.mcap"))

    def midway(self) -> None:
        """Wait until samples are in the file."""
        start = 64 * 1024
        assert until(lambda: self.bag_size() > start or self.process.poll() is not None)
        assert self.process.poll() is None, text_of(self.err)

    def finish(self, patience: float = PATIENCE) -> Finished:
        status = self.process.wait(patience)
        return Finished(status, text_of(self.out), text_of(self.err))


def _die_with_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def open_files(pid: int) -> set[Path]:
    """Files in shared memory that a process has open or mapped."""
    words = Path(f"/proc/{pid}/maps").read_text(errors="replace").split()
    with contextlib.suppress(OSError):
        for file in Path(f"/proc/{pid}/fd").iterdir():
            with contextlib.suppress(OSError):
                words.append(os.readlink(file))
    return {Path(word) for word in words if word.startswith("/dev/shm/")}


def alive(pid: int) -> bool:
    """Whether a process is there and is no zombie."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
    return stat.rpartition(")")[2].split()[0] not in "ZX"


def all_ended(children: dict[str, int], patience: float = PATIENCE) -> bool:
    """Whether none of the processes is left, at last."""
    return bool(until(lambda: not any(map(alive, children.values())), patience))


@pytest.fixture
def start_pea(tmp_path: Path) -> Iterator[Callable[..., Running]]:
    """Start `pea` in a fresh directory, as a process of its own."""
    started: list[Running] = []

    def start(*arguments: str, env: dict[str, str] | None = None, **options: Any) -> Running:
        there = tmp_path / f"user{len(started)}"
        there.mkdir()
        started.append(Running(arguments, there, env or clean_environment(), **options))
        return started[-1]

    yield start
    for running in started:
        children = running.children()
        if running.process.poll() is None:
            running.process.kill()
            running.process.wait()
        all_ended(children, 10.0)
        for pid in filter(alive, children.values()):
            os.kill(pid, signal.SIGKILL)


@pytest.fixture
def ended() -> Callable[..., bool]:
    return all_ended


@pytest.fixture(name="open_files")
def _open_files() -> Callable[[int], set[Path]]:
    return open_files


@pytest.fixture
def user_environment() -> Callable[..., dict[str, str]]:
    return clean_environment


@pytest.fixture
def free_domain() -> Iterator[int]:
    """A ROS domain for this test alone."""
    with domain_id() as domain:
        yield domain


class Run(NamedTuple):
    directory: Path
    metrics: dict[str, Any]


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Run]:
    """Run an experiment in a mode, once for the same question; a bag and its metrics.

    The processes that share the tests share the runs. Nobody changes one.
    """
    base = tmp_path_factory.getbasetemp()
    runs = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "runs"
    runs.mkdir(exist_ok=True)

    def run(mode: str, *arguments: str) -> Run:
        question = repr((mode, *arguments)).encode()
        there = runs / f"{mode}-{hashlib.sha256(question).hexdigest()[:16]}"
        there.mkdir(exist_ok=True)
        done = there / "done.json"
        with open(there / "lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not done.exists():
                shutil.rmtree(there / "run", ignore_errors=True)  # of a run that has failed
                command = ("run", *arguments, "--mode", mode, "--json")
                metrics = _here(command, there) if mode == "batch" else _started(command, there)
                done.write_text(json.dumps(metrics))
        return Run(there / "run", json.loads(done.read_text()))

    return run


def _started(command: tuple[str, ...], there: Path) -> dict[str, Any]:
    """Metrics of a run in a process of its own."""
    return Running((*command, "--out", "run"), there, clean_environment()).finish(100.0).metrics


def _here(command: tuple[str, ...], there: Path) -> dict[str, Any]:
    """Metrics of a run in this process, which has loaded the libraries already."""
    from pea_cli import cli

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    said = io.StringIO()  # a test reads only what its own commands print
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            status = cli.main([*command, "--no-report", "--out", str(there / "run")])
        assert status == 0, said.getvalue()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    found: dict[str, Any] = json.loads((there / "run" / "metrics.json").read_text())
    return found


def _executable(node: str) -> Path:
    """What ``ros2 run`` starts."""
    package = "pea_run" if node == RECORDER else f"pea_{node}"
    return Path(get_package_prefix(package)) / "lib" / package / node


@pytest.fixture
def executable() -> Callable[[str], Path]:
    return _executable


class Ros:
    """A ROS domain of a test's own, with a node in it that is none of pea's."""

    def __init__(self, domain: int, there: Path) -> None:
        self.there = there
        self.env = clean_environment(
            ROS_DOMAIN_ID=str(domain),
            ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST",
            FASTRTPS_DEFAULT_PROFILES_FILE=str(config.config_dir() / "fastdds.xml"),
            ROS_LOG_DIR=str(there),
            PYTHONUNBUFFERED="1",
            PEA_COMPILE="0",  # nothing compiles beside a test that looks at something else
        )
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = Node("_tester", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def start(self, node: str, *arguments: str) -> subprocess.Popen[bytes]:
        """Start a node of pea as ``ros2 run`` does."""
        with open(self.there / f"{node}.txt", "wb") as log:
            self.processes[node] = subprocess.Popen(
                [str(_executable(node)), *arguments],
                env=self.env,
                cwd=self.there,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                preexec_fn=_die_with_parent,
            )
        return self.processes[node]

    def log(self, node: str) -> str:
        return text_of(self.there / f"{node}.txt")

    def until(self, true: Callable[[], Any], patience: float = PATIENCE) -> Any:
        """Serve the test's node until a condition is met; give what it says at last."""
        end = time.monotonic() + patience
        while not (found := true()) and time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.02)
        return found

    def says(self, node: str, words: str) -> None:
        """Wait until a node has logged some words."""
        assert self.until(lambda: words in self.log(node)), f"{words!r} not in: {self.log(node)}"

    def end(self, node: str, signum: int = signal.SIGINT) -> int:
        """Signal a node; its exit status."""
        process = self.processes[node]
        if process.poll() is None:
            process.send_signal(signum)
        return process.wait(20.0)

    def close(self) -> None:
        for process in self.processes.values():
            if process.poll() is None:
                process.kill()
            process.wait()
        nodes = [*self.executor.get_nodes()]  # those of a test that has failed, too: they would
        self.executor.shutdown()  # stay in the domain, which the next one takes
        for node in nodes:
            node.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def ros(tmp_path: Path, free_domain: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ros]:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(config.config_dir() / "fastdds.xml"))
    there = Ros(free_domain, tmp_path)
    try:
        yield there
    finally:
        there.close()
