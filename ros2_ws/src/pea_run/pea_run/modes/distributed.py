"""Four processes and a recorder, exchanging topics in lock-step.

This process starts the installed executables, as ``ros2 run`` would, and watches them; it takes
no part in the loop.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import selectors
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_prefix

from pea_core import config
from pea_core.config import NAMESPACE, NODES
from pea_core.loop import LoopFault
from pea_core.params import ParameterError
from pea_engine.compiled import SWITCH as COMPILE
from pea_experiment.experiment import SECTION, AnyExperiment
from pea_experiment.experiments import PARAMS
from pea_record import carried
from pea_record.bag import WHOLE, Split
from pea_record.trigger import Trigger
from pea_ros.discovery import stay
from pea_ros.paths import PROGRESS, TURBO
from pea_ros.paths import SWITCH as TRANSPORT
from pea_wire.topics import RECORDER

BAD_INPUT = 2
"""Exit status of a node that refuses what it was given."""

SLOW = 5e-3
"""Period (s) from which on a compiled hop has nothing to hurry for."""

GRACE = 2.0
"""Seconds that a process has to end when asked, before it is killed."""

STARTING = 120.0
"""Seconds that the nodes have to find each other, and to compile where that is waited for."""

BEGINNING = 40.0
"""Seconds to the first sample, for which a plant in wall time waits up to 30 s."""

STALLED = 10.0
"""Seconds without a new sample after which a run has failed."""

LOOK = 1.0
"""Longest pause between two looks (s) that counts: after a longer one this process was stopped."""

_LIBC = ctypes.CDLL(None)
_PR_SET_PDEATHSIG = 1


def _heed_interrupts() -> None:
    """In a child: obey SIGINT, and get it from the kernel when the parent dies, however it dies.

    It is held back until Python has started and `pea_core.entry` takes it without a word.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT,))
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGINT)


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Hold Ctrl-C off, so that what ends the nodes is not ended itself."""
    held: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            while number not in held:
                with contextlib.suppress(KeyboardInterrupt):
                    held[number] = signal.signal(number, signal.SIG_IGN)
    try:
        yield
    finally:
        for taken, handler in held.items():
            signal.signal(taken, handler)


def executable(name: str) -> Path:
    """Installed executable of a node or of the recorder."""
    package = "pea_run" if name == RECORDER else f"pea_{name}"
    return Path(get_package_prefix(package)) / "lib" / package / name


DOMAINS = range(1, 101)
"""ROS domains that a run may take for its own."""

DOMAIN_PORT = 32768
"""TCP port plus domain: who holds it has the domain. ROS's own tests go by it, too."""


def own_domain() -> tuple[int, socket.socket]:
    """A ROS domain that no other run has, and the socket that holds it while it is open.

    Raises
    ------
    LoopFault
        All of them are taken.
    """
    for domain in DOMAINS:
        holder = socket.socket()
        try:
            holder.bind(("", DOMAIN_PORT + domain))
        except OSError:
            holder.close()
        else:
            return domain, holder
    raise LoopFault(f"no free ROS domain in {DOMAINS[0]} to {DOMAINS[-1]}: set ROS_DOMAIN_ID")


@contextlib.contextmanager
def environment() -> Iterator[tuple[dict[str, str], tuple[int, ...]]]:
    """Environment of the nodes: a ROS domain of their own, discovery on this machine only.

    Yields
    ------
    dict
        The environment.
    tuple of int
        What the nodes must inherit: it holds their domain until the last of them has ended.
    """
    env = dict(os.environ)
    stay(env)
    with contextlib.ExitStack() as stack:
        held: tuple[int, ...] = ()
        if not env.get("ROS_DOMAIN_ID"):
            domain, holder = own_domain()
            stack.enter_context(holder)
            env["ROS_DOMAIN_ID"] = str(domain)
            held = (holder.fileno(),)
        yield env, held


def core() -> int:
    """Core for the loop's processes: the last one; -1 if the machine has only one."""
    cores = os.sched_getaffinity(0)
    return max(cores) if len(cores) > 1 else -1


class Crew:
    """The processes of a run, started, watched and ended together.

    Parameters
    ----------
    log : Path
        Directory of their logs, one file each.
    env : Mapping
        Their environment.
    held : tuple of int
        Open files that they inherit.
    """

    def __init__(self, log: Path, env: Mapping[str, str], held: tuple[int, ...] = ()) -> None:
        self.log = log
        self.held = held
        self.env = {**env, "ROS_LOG_DIR": str(log)}
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        log.mkdir(parents=True)

    def start(self, name: str, *arguments: str, **options: Any) -> subprocess.Popen[bytes]:
        """Start a node; it gets its own session, so that Ctrl-C comes to us alone."""
        with open(self.log / f"{name}.log", "wb") as log:
            self.processes[name] = subprocess.Popen(
                [str(executable(name)), "--ros-args", *arguments],
                env=self.env,
                stdin=subprocess.DEVNULL,
                stdout=options.pop("stdout", log),
                stderr=log,
                start_new_session=True,
                pass_fds=self.held,
                preexec_fn=_heed_interrupts,
            )
        return self.processes[name]

    def check(self) -> None:
        """See that every process lives or has ended well.

        Raises
        ------
        LoopFault
            One has failed; it is named, with its last words.
        ParameterError
            One has refused what it was given: a device that is not there, for example.
        """
        for name, process in self.processes.items():
            status = process.poll()
            if status:
                words = self.last_words(name)
                if status == BAD_INPUT:
                    raise ParameterError(f"{name}{words}")
                raise LoopFault(f"{name} {_end(status)}{words}")

    def last_words(self, name: str) -> str:
        """Last line that a process wrote, behind a colon."""
        lines = (self.log / f"{name}.log").read_text(errors="replace").split("\n")
        words = next((line for line in reversed(lines) if line.strip()), "")
        return f": {words.removeprefix(name + ': ')}" if words else ""

    def end(self) -> None:
        """End all: the blocks first, then the recorder, so that it closes the bag last."""
        blocks = [p for name, p in self.processes.items() if name != RECORDER]
        for group in (blocks, [p for p in self.processes.values() if p not in blocks]):
            for process in group:
                if process.poll() is None:
                    process.send_signal(signal.SIGINT)
            until = time.monotonic() + GRACE
            for process in group:
                try:
                    process.wait(max(until - time.monotonic(), 0.0))
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()


def _end(status: int) -> str:
    if status < 0:
        return f"was killed by {signal.Signals(-status).name}"
    return f"ended with status {status}"


def run(
    experiment: AnyExperiment,
    out: Path,
    progress: Callable[[int], None],
    split: Split = WHOLE,
    wall: bool = False,
    cpu: int | None = None,
    recorded: bool = True,
    namespace: str = NAMESPACE,
    trigger: Trigger | None = None,
) -> None:
    """Run an experiment and record it in `out`; in wall time the plant paces, else all wait.

    Of a `trigger` only the windows are recorded. Not `recorded`, there is no recorder; the plant
    tells the progress, once a second. The nodes are in `namespace`.

    Raises
    ------
    LoopFault
        A process failed; the others are ended and the bag is closed.
    """
    loop: dict[str, Any] = {"samples": experiment.samples, "wait_for_recorder": recorded}
    loop["cpu"] = (-1 if cpu is None else cpu) if wall else core()
    values: dict[str, dict[str, Any]] = {
        RECORDER: of_recorder(experiment, out, split, trigger),
        **{node: dict(loop) for node in NODES},
    }
    if wall:
        values["plant"]["clock"] = "wall"
    given = experiment.sections()
    for node, name, _ in carried.named(given):  # in PARAMS they stand without their directory
        values[node][name] = given[node][name]
    with environment() as (env, held):
        if wall:  # nothing is compiled while time goes on: before, or not at all
            if experiment.T_s < SLOW:
                env[TRANSPORT] = env.get(TRANSPORT) or TURBO
            else:
                env[COMPILE] = "0"
        told = out / "log" / "samples"
        env[PROGRESS] = str(told.absolute())
        crew = Crew(out / "log", env, held)
        start = crew.log / "start.yaml"
        params = out / PARAMS
        if namespace != NAMESPACE:
            params = crew.log / PARAMS
            config.write(params, config.read(out / PARAMS, (SECTION, *NODES)), namespace)
        config.write(start, values, namespace)
        placed = ("--params-file", str(start), "-r", f"__ns:={namespace}")
        try:
            if recorded:
                crew.start(RECORDER, *placed, stdout=subprocess.PIPE)
            for node in NODES:
                crew.start(node, "--params-file", str(params), *placed)
            if recorded:
                watch(crew, crew.processes[RECORDER], experiment.samples, progress)
            else:
                wait(crew, told, progress)
        finally:
            with undisturbed():
                crew.end()
            recorder = crew.processes.get(RECORDER)
            if recorder is not None and recorder.stdout is not None:
                recorder.stdout.close()


def of_recorder(
    experiment: AnyExperiment, out: Path, split: Split, trigger: Trigger | None
) -> dict[str, Any]:
    """Parameters of the recorder."""
    values: dict[str, Any] = {
        "out": str(out),
        "experiment": experiment.name,
        "samples": experiment.samples,
        "T_s": experiment.T_s,
    }
    if split != WHOLE:
        values |= {"split_size": split.size, "split_duration": split.duration}
    if trigger is not None:
        given = trigger._asdict().items()
        values |= {f"trigger_{n}": v for n, v in given if v == v}  # NaN: it has no level
    return values


class Patience:
    """How long nothing has moved: seconds in which this process ran, none while it was stopped.

    Parameters
    ----------
    crew : Crew
        Whose last words are told.
    now : callable
        Clock (s).
    """

    def __init__(self, crew: Crew, now: Callable[[], float] = time.monotonic) -> None:
        self.crew = crew
        self.done = -1
        self._now = now
        self._looked = now()
        self._waited = 0.0

    def move(self, done: int) -> bool:
        """Take note of how many samples are done; whether they are more than before."""
        if done <= self.done:
            return False
        self.done, self._waited = done, 0.0
        return True

    def look(self) -> None:
        """See whether the nodes live and the loop moves; called some times a second.

        Raises
        ------
        LoopFault
            Not for too long: every node's last words are told.
        """
        self.crew.check()
        now = self._now()
        self._waited += min(now - self._looked, LOOK)  # a longer pause was ours
        self._looked = now
        if self._waited > {-1: STARTING, 0: BEGINNING}.get(self.done, STALLED):
            words = "; ".join(f"{name}{self.crew.last_words(name)}" for name in self.crew.processes)
            raise LoopFault(
                f"the loop stands still at sample {self.done}: {words}"
                if self.done >= 0
                else f"the nodes did not find each other in {STARTING:g} s: {words}"
            )


def wait(crew: Crew, told: Path, progress: Callable[[int], None]) -> None:
    """Wait until the plant has done its samples, of which it tells once a second."""
    progress(0)
    patience = Patience(crew)
    while crew.processes["plant"].poll() is None:
        with contextlib.suppress(OSError, ValueError):
            if patience.move(int(told.read_text())) and patience.done:
                progress(patience.done)
        patience.look()
        time.sleep(0.1)
    crew.check()


def watch(
    crew: Crew,
    recorder: subprocess.Popen[bytes],
    samples: int,
    progress: Callable[[int], None],
) -> None:
    """Pass on the recorder's progress until it has everything."""
    assert recorder.stdout is not None
    os.set_blocking(recorder.stdout.fileno(), False)
    patience = Patience(crew)
    buffer = b""
    with selectors.DefaultSelector() as selector:
        selector.register(recorder.stdout, selectors.EVENT_READ)
        while patience.done < samples:
            if selector.select(0.1):
                data = os.read(recorder.stdout.fileno(), 65536)
                if not data:
                    recorder.wait()
                    crew.check()
                    done = max(patience.done, 0)
                    raise LoopFault(f"recorder ended at sample {done} of {samples}")
                *lines, buffer = (buffer + data).split(b"\n")
                for line in lines:
                    if line.isdigit() and patience.move(int(line)):
                        progress(patience.done)
            patience.look()
    try:
        recorder.wait(STALLED)
    except subprocess.TimeoutExpired:
        words = crew.last_words(RECORDER)
        raise LoopFault(f"recorder has not closed the bag within {STALLED:g} s{words}") from None
    crew.check()
