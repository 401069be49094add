"""A random walk through what may happen to a rig, against a model of what must hold.

``.ci/env python tests/walk.py [--steps N] [--seed N] [--jobs N] [--rig NAME]``, or ``make walk``.
Hypothesis draws the steps; the four nodes and the emulated device are real, and go on from step to
step. A step that breaks a rule ends the walk with status 1, its sequence and the directory of the
logs. Of several `jobs` each has a rig of its own.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import importlib
import importlib.util
import math
import os
import re
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from hypothesis import HealthCheck, Phase, seed, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    rule,
    run_state_machine_as_test,
)

from pea_core.config import NODES
from pea_plant import gate
from pea_watchdog import client
from pea_wire.topics import OWNED

spec = importlib.util.spec_from_file_location("pea_faults", Path(__file__).with_name("faults.py"))
assert spec is not None
assert spec.loader is not None
faults = sys.modules.get("pea_faults") or importlib.util.module_from_spec(spec)
if "pea_faults" not in sys.modules:
    sys.modules["pea_faults"] = faults
    spec.loader.exec_module(faults)

STEPS, LENGTH = 10_000, 50
"""Steps of a walk, and from one healthy rig to the next."""

RATE = ("T_s=0.02", "controller.K_i=75.0", "plant.safety.stale_samples=10")
"""A rate of which a processor bears several rigs; what must hold does not depend on it."""

HANG = 10.0
"""Seconds after which whatever does not answer, end or come to rest hangs."""

START = 60.0
"""Seconds that Python and the middleware have to start, on a machine with other loads."""

ALONE = 8
"""Of so many sequences one is of the loop in one process."""

LOST, LOST_ONCE = 1.0, 7.0
"""Seconds after which a node that was just started, and has not answered yet, is asked again: what
may be asked twice, and what changes its state."""

AGE = 3
"""Steps that a lasting fault of the device stays: to dial a silent device takes 5 s."""

SEEN = 1.0
"""Seconds that a command may be under way: the limits at any time of them count."""

MARK = "PEA_WALK"
"""Environment variable by which the walk knows its processes again."""

LASTING = ("refuse", "mute", "delay=0.25", "drip=0.05", "babble", "stuck", "jump=5")
ONCE = ("drop", "truncate", "garbage", "error=10", "error=79")
DEVICE = (*LASTING, *ONCE, "pull")
"""Faults of the device; `ONCE` are over by themselves."""

COUNTED = re.compile(rb"\] (\d+)/\d+ ")
"""Steps done, as a walk prints them."""

AGREE = {
    "unconfigured": ("unconfigured",),
    "inactive": ("inactive", "fault"),
    "active": ("active",),
    "finalized": ("unconfigured", "inactive", "fault"),
}
"""States of the gate that a lifecycle state goes with."""

TRACEBACK = re.compile(r"Traceback \(most recent|Fatal Python error|Segmentation fault")

LOGGED = re.compile(r"\[pea\.plant\]: \w+ -> (\w+): ")

TIGHTEN = {
    "voltage_min": (-15.0, -5.0),
    "voltage_max": (60.0, 105.0),
    "safety.slew_rate": (600.0, 1900.0),
    "safety.soft_start_rate": (300.0, 490.0),
    "safety.safe_voltage": (-4.0, 30.0),
    "safety.beyond": (50.0, 129.0),
    "safety.jump_um": (1.5, 2.9),
    "safety.displacement_max_um": (14.0, 17.0),
    "safety.watchdog_s": (0.3, 0.49),
}
"""Limits of the gate, and values tighter than the rig's, within which the sine still fits."""

LAWS = (
    ("controller", "K_i", (100.0, 300.0, 900.0, 1e6, -300.0)),
    ("controller", "feedforward", (True, False)),
    ("controller", "type", ("open_loop", "pid", "smc", "pidsmc")),
    ("controller", "preview_samples", (0.0, 0.5, 2.0)),
    ("observer", "type", ("alpha_beta", "kalman", "passthrough", "luenberger")),
    ("observer", "omega_o", (50.0, 150.0, 1e5)),
    ("reference", "frequency_hz", (0.5, 1.0, 50.0)),
    ("reference", "amplitude_um", (0.0, 5.0, 50.0)),
)
NONSENSE = (math.nan, math.inf, -math.inf, 1e308, -1, 0, 10**15, True, "", "\x1b[31m", "[/red]",
            [1.0, 2.0], ["a"], None)  # fmt: skip
NAMES = ("safety.slew_rate", "safety.stale_samples", "voltage_max", "driver.address", "T_s",
         "driver.type", "type", "K_p", "no.such", "clock", "use_sim_time", "delay_samples",
         "sensor.noise_nm", "safety.watchdog_s", "preset")  # fmt: skip

Broken = AssertionError


class Limits(NamedTuple):
    """Range (V), fastest change (V/s), safe voltage (V) of a gate."""

    low: float
    high: float
    slew: float
    safe: float

    def with_(self, name: str, value: float) -> Limits:
        """With one parameter changed."""
        field = {
            "voltage_min": "low",
            "voltage_max": "high",
            "safety.slew_rate": "slew",
            "safety.safe_voltage": "safe",
        }.get(name)
        return self if field is None else self._replace(**{field: value})

    def outside(self, u: float) -> float:
        """How far a voltage is outside the range (V)."""
        return max(u - self.high, self.low - u, 0.0)

    def step(self, seconds: float, T_s: float) -> float:
        """Largest change (V) in that time; a ramp of plant or watchdog has steps."""
        if self.slew <= 0.0:  # asked for, and refused
            return 0.0
        span = client.RampLimits(
            self.low, self.high, min(max(self.safe, self.low), self.high), self.slew
        )
        period, _ = client.levels(span)
        return self.slew * max(seconds, T_s, period)


class Held:
    """The limits in force over time, as far as an answer to a request can tell."""

    def __init__(self, first: Limits) -> None:
        self.now = first
        self._known: list[tuple[int, Limits]] = [(0, first)]

    def change(self, to: Limits) -> None:
        """Other limits are in force from now on."""
        self.now = to
        self.maybe(to)

    def maybe(self, to: Limits) -> None:
        """Other limits may be in force from now on."""
        self._known.append((time.monotonic_ns(), to))

    def at(self, t: int) -> list[Limits]:
        """All that may have been in force when what came at t (ns) was sent."""
        until = t - int(SEEN * 1e9)
        while len(self._known) > 1 and self._known[1][0] < until - int(60e9):
            del self._known[0]
        before = [one for when, one in self._known if when <= until][-1:]
        return before + [one for when, one in self._known if until < when <= t]


class Felt:
    """What the device has felt, against the limits in force."""

    def __init__(self, control: Any, T_s: float, first: Limits) -> None:
        self.control, self.T_s = control, T_s
        self.held = Held(first)
        self.last = (time.monotonic_ns(), self.voltage())
        self.peak = self.steepest = 0.0

    def voltage(self) -> float:
        """Voltage of the last command (V)."""
        last = self.control.log()["last_voltage_V"]
        return last["value"] if last else 0.0

    def check(self) -> None:
        """Look at every command since the last look."""
        for t, u in self.control.since(self.last[0] + 1):
            self.judge(t, u)

    def judge(self, t: int, u: float) -> None:
        """One command.

        Raises
        ------
        AssertionError
            It is outside the range and not on its way back, or changes too fast.
        """
        (s, v), self.last = self.last, (t, u)
        held = self.held.at(t)
        outside = min(one.outside(u) - one.outside(v) for one in held if one.outside(u) >= 0.0)
        if min(one.outside(u) for one in held) > 1e-6 and outside > 1e-6:
            raise Broken(f"{u:.4f} V is outside of {held}; before {v:.4f} V")
        seconds = (t - s) * 1e-9
        most = max(one.step(seconds, self.T_s) for one in held)
        if abs(u - v) > most * 1.01 + 1e-3:
            raise Broken(
                f"from {v:.4f} to {u:.4f} V in {seconds * 1e3:.3f} ms, at most {most:.4f} V: {held}"
            )
        self.peak = max(self.peak, abs(u))


def processes(mark: str) -> dict[int, tuple[int, str, str]]:
    """Parent, state and command of every process with a mark."""
    found = {}
    token = f"{MARK}={mark}".encode()
    for entry in os.listdir("/proc"):
        if not entry.isdecimal():
            continue
        there = Path("/proc") / entry
        with contextlib.suppress(OSError):
            if token not in (there / "environ").read_bytes():
                continue
            rest = (there / "stat").read_text(errors="replace").rpartition(")")[2].split()
            command = (there / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            if rest[0] not in "ZX":
                found[int(entry)] = int(rest[1]), rest[0], command
    return found


class Lab(faults.Loop):  # type: ignore[misc]
    """The four nodes, and a node beside them that asks, sets, listens and publishes."""

    PROCESSES: tuple[str, ...] = NODES

    def process(self, node: str) -> str:
        """Process in which a node is."""
        return node

    def begin(self) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node

        self.mark = secrets.token_hex(8)
        self.env[MARK] = self.mark
        for variable in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE"):
            os.environ[variable] = self.env[variable]
        context = Context()
        rclpy.init(context=context, domain_id=int(self.env["ROS_DOMAIN_ID"]))
        self.executor = SingleThreadedExecutor(context=context)
        self._stack.callback(rclpy.shutdown, context=context)
        self.node = Node("_walk", context=context)
        self._stack.callback(self.node.destroy_node)
        self.executor.add_node(self.node)
        self._stack.callback(self.executor.shutdown)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._hear, 500)
        plant = self.experiment.nodes["plant"].params
        safety = plant.safety
        self.first = Limits(
            plant.voltage_min, plant.voltage_max, safety.slew_rate, safety.safe_voltage
        )
        self.felt = Felt(self.control, self.experiment.T_s, self.first)
        self.gate = ""  # as the plant has told last
        self.transitions = self.stops = 0
        self.unwatched = False
        self.lasting: set[str] = set()
        self.age = 0
        self.calm_since = time.monotonic()
        self._met: set[tuple[Any, str]] = set()
        self.asked_to_end: set[str] = set()
        self.doubled: set[str] = set()
        self.rogues: dict[str, Any] = {}
        self.wrong: list[str] = []
        self.values: dict[tuple[str, str], Any] = {}
        self._told, self._told_to = (0, ""), 0
        self._read: dict[Path, int] = {}
        self._alone: dict[int, float] = {}
        self._made: dict[tuple[Any, str], Any] = {}
        for node in self.PROCESSES:
            self.launch(node)
        self.ready()

    # What it says

    def told(self) -> tuple[int, str]:
        """How many transitions the plant has logged, and to which state the last one was."""
        with open(self.crew.log / "plant.log", "rb") as file:
            file.seek(self._told_to)
            whole, end, _ = file.read().rpartition(b"\n")
        self._told_to += len(whole + end)
        for found in LOGGED.findall(whole.decode(errors="replace")):
            self._told = self._told[0] + 1, found
        return self._told

    @property
    def gate_state(self) -> str:
        """State of the gate by the plant's log.

        Diagnostics can be late by seconds where the middleware's threads get no processor, and
        those of a plant that has been killed come after the next one has started.
        """
        return self.told()[1] or "unconfigured"

    def own(self, name: str, node: str = "plant") -> Any:
        """Value of a parameter in the node's file; None where it has none."""
        return self.experiment.nodes[node].values.get(name)

    def _hear(self, message: Any) -> None:
        for status in message.status:
            if status.name == "pea: plant: gate":
                self.gate = status.message
            elif status.name == "pea: plant: safety":
                self.transitions += 1
                _, _, rest = status.message.partition(" -> ")
                after, _, cause = rest.partition(": ")
                self.gate = after
                if after == "fault" and cause.partition(":")[0] not in gate.REASONS[1:]:
                    self.wrong.append(f"a fault without a reason: {status.message!r}")
                if "emergency_stop" in cause and not self.stops:
                    self.wrong.append(f"nobody has asked for a stop: {status.message!r}")

    def spin(self, seconds: float = 0.0) -> None:
        """Hear what has come."""
        end = time.monotonic() + seconds
        while True:
            self.executor.spin_once(timeout_sec=max(min(end - time.monotonic(), 0.02), 0.0))
            if time.monotonic() >= end:
                return

    def wait(self, true: Callable[[], Any], what: str, patience: float = HANG) -> Any:
        """Wait for a condition.

        Raises
        ------
        AssertionError
            It is not met in time.
        """
        end = time.monotonic() + patience
        while not (found := true()):
            if time.monotonic() > end:
                raise Broken(f"{what}: not within {patience:g} s")
            self.spin(0.01)
        return found

    # Processes

    def launch(self, node: str) -> None:
        """Start a node that is not there."""
        self.asked_to_end.discard(node)
        self.doubled.discard(node)
        self.values = {key: value for key, value in self.values.items() if key[0] != node}
        self._met = {key for key in self._met if not key[1].startswith(f"{node}/")}
        if node == "plant":
            self.gate, self.stops, self.unwatched = "", 0, False
            if (self.crew.log / "plant.log").exists():  # what the last one has said
                self._told = self.told()[0], ""
            self.felt.held.change(self.first)
        self.start(node)

    def alive(self, node: str) -> bool:
        return self.crew.processes[self.process(node)].poll() is None

    def ready(self) -> bool:
        """Wait until a plant that was started answers, or has ended as the device is not there."""
        from lifecycle_msgs.srv import GetState

        def answers() -> bool:
            if not self.alive("plant"):
                return True
            return bool(self.gate) and self.ask(GetState, "plant/get_state", START) is not None

        self.wait(answers, "a started plant", START)
        return self.alive("plant")

    def end(self, node: str, number: int) -> None:
        """Signal a node that then has to end."""
        self.asked_to_end.add(node)
        self.crew.processes[node].send_signal(number)
        what = f"{node} ends after {signal.Signals(number).name}"
        self.wait(lambda: not self.alive(node), what)

    def watchdogs(self) -> list[int]:
        """The plant's watchdogs."""
        plant = self.crew.processes["plant"].pid
        return [
            pid
            for pid, (parent, _, command) in processes(self.mark).items()
            if parent == plant and "watchdog.py" in command
        ]

    # Services

    def client(self, kind: Any, name: str) -> Any:
        if (kind, name) not in self._made:
            self._made[kind, name] = self.node.create_client(kind, f"/pea/{name}")
        return self._made[kind, name]

    def ask(self, kind: Any, name: str, patience: float = 0.0, **request: Any) -> Any:
        """Ask a node; its answer, None where it has ended meanwhile.

        Raises
        ------
        AssertionError
            It does not answer in time.
        """
        node = name.partition("/")[0]
        client, pending = self.client(kind, name), []
        met = (kind, name) in self._met
        started = not any(each.startswith(f"{node}/") for _, each in self._met)
        patience = patience or (START if started else HANG)
        lost = LOST if name.rpartition("/")[2] in ("get_state", "set_parameters") else LOST_ONCE
        end, again = time.monotonic() + patience, 0.0
        while time.monotonic() < end:
            now = time.monotonic()
            if now >= again and client.service_is_ready():
                pending.append(client.call_async(kind.Request(**request)))
                # one that is not known to a node just started is lost
                again = math.inf if met else now + lost
            self.executor.spin_once(timeout_sec=0.01)
            for future in pending:
                if future.done():
                    self._met.add((kind, name))
                    return future.result()
            if not self.alive(node):
                return None
        raise Broken(f"/pea/{name} does not answer within {patience:g} s")

    def trigger(self, name: str) -> Any:
        from std_srvs.srv import Trigger

        if name == "stop":
            self.stops += 1
        answer = self.ask(Trigger, f"plant/{name}")
        if answer is not None and not answer.success:
            assert answer.message, f"~/{name} is refused without a reason"
        return answer

    def lifecycle(self) -> str:
        from lifecycle_msgs.srv import GetState

        answer = self.ask(GetState, "plant/get_state")
        return "" if answer is None else str(answer.current_state.label)

    def set(self, node: str, name: str, value: Any) -> Any:
        """Set a parameter; the answer."""
        from rcl_interfaces.srv import SetParameters
        from rclpy.parameter import Parameter

        wanted = Parameter(name, value=value).to_parameter_msg()
        limits = self.felt.held.now
        to = limits
        if node == "plant" and type(value) in (int, float) and math.isfinite(value):
            to = limits.with_(name, value)
            self.felt.held.maybe(to)
        answer = self.ask(SetParameters, f"{node}/set_parameters", parameters=[wanted])
        if answer is None:
            return None
        (result,) = answer.results
        if result.successful:
            self.felt.held.change(to)
            self.values[node, name] = value
        else:
            self.felt.held.change(limits)
            assert result.reason, f"{node} {name} = {value!r} is refused without a reason"
            assert "\n" not in result.reason, result.reason
        return result

    # The device

    @property
    def calm(self) -> bool:
        return not self.lasting

    def inject(self, text: str) -> None:
        self.control.fault(text)
        if text not in ONCE:
            self.lasting.add(text)

    def mend(self) -> None:
        self.control.clear()
        if self.lasting:
            self.calm_since = time.monotonic()
        self.lasting.clear()
        self.age = 0

    # What must hold

    def check(self) -> None:
        """Look at everything that must hold after every step."""
        self.spin()
        self.felt.check()
        assert not self.wrong, self.wrong
        self.check_logs()
        self.check_processes()
        if self.alive("plant"):
            self.check_states()
        self.check_rest()
        self.felt.check()

    def check_logs(self) -> None:
        for path in self.crew.log.glob("*.log"):
            start = self._read.get(path, 0)
            with open(path, "rb") as file:
                file.seek(max(start - 100, 0))
                text = file.read().decode(errors="replace")
                self._read[path] = file.tell()
            if found := TRACEBACK.search(text):
                raise Broken(f"{path}: {text[found.start() :][:3000]}")

    def check_processes(self) -> None:
        """Nobody has ended by himself but in order, and nobody is left."""
        for node in self.PROCESSES:
            status = self.crew.processes[node].poll()
            if status is None or node in self.asked_to_end:
                continue
            words = self.crew.last_words(node)
            if not (status in (2, 3) and words and self.may_end(node, status, words)):
                raise Broken(f"{node} has ended with status {status}{words}")
            self.asked_to_end.add(node)
        there = processes(self.mark)
        ours = {process.pid for process in self.crew.processes.values()} | {os.getpid()}
        alone = {pid for pid, (parent, _, _) in there.items() if parent not in ours and
                 parent not in there and pid not in ours}  # fmt: skip
        now = time.monotonic()
        self._alone = {pid: self._alone.get(pid, now) for pid in alone}
        for pid, since in self._alone.items():
            if self.calm and now - max(since, self.calm_since) > 2 * HANG:
                raise Broken(f"process {pid} is nobody's child: {there[pid]}")

    started_into_faults = False

    def may_end(self, node: str, status: int, words: str) -> bool:
        """Whether a process may end so, unasked: the plant, where it was started into faults."""
        if status == 2 and "end the other one first" in words:
            # it was started beside somebody else, or both were starting and no one was the first
            return bool(self.rogues) or node in self.doubled
        return node != "plant" or self.started_into_faults

    def check_states(self) -> None:
        """Lifecycle and gate agree."""
        seen = ["", ""]

        def agree() -> bool:
            seen[:] = self.lifecycle(), self.gate_state
            if not self.alive("plant") or not seen[0]:
                return True
            return seen[1] in AGREE.get(seen[0], ())

        try:
            self.wait(agree, "agreement")
        except AssertionError as error:
            said = f"lifecycle {seen[0]}, gate {seen[1]} (by its diagnostics {self.gate})"
            raise Broken(f"{said}: {error}") from None

    def check_rest(self) -> None:
        """Where the gate is not active the stage comes to rest, if the device lets it."""
        if not self.calm or self.unwatched:
            return

        def rests() -> bool:
            if self.alive("plant") and self.gate in ("active", ""):
                return True
            return abs(self.felt.voltage() - self.felt.held.now.safe) < faults.REST

        try:
            self.wait(rests, "rest", 2 * HANG)
        except AssertionError as error:
            raise Broken(f"{self.felt.voltage():.3f} V in {self.gate}: {error}") from None

    # Back to health

    def heal(self) -> None:
        """Mend everything; then the loop runs again.

        Raises
        ------
        AssertionError
            It does not.
        """
        self.mend()
        for rogue in list(self.rogues):
            self.dismiss(rogue)
        for node in self.PROCESSES:
            if not self.alive(node):
                self.start_again(node)

        if any(node == "plant" for node, _ in self.values):
            self.trigger("stop")
        for node, name in list(self.values):
            own = self.own(name, node)
            if own is not None and self.values[node, name] != own:
                self.set(node, name, own)

        def runs() -> bool:
            if not self.alive("plant"):
                self.start_again("plant")
            self.trigger("reset")
            if self.lifecycle() == "unconfigured":
                self.transit("configure")
            answer = self.trigger("enable")
            if answer is None or not (answer.success or "active, " in answer.message):
                said.append(answer.message if answer else "")
                self.spin(0.2)
                return False
            return True

        said: list[str] = []
        try:
            self.wait(runs, "a healthy rig runs", START)
        except AssertionError as error:
            raise Broken(f"{error}: {said[-3:]}") from None

    def transit(self, label: str, number: int | None = None) -> Any:
        from lifecycle_msgs.msg import Transition
        from lifecycle_msgs.srv import ChangeState

        transition = Transition(id=TRANSITIONS[label] if number is None else number)
        return self.ask(ChangeState, "plant/change_state", transition=transition)

    def start_again(self, node: str) -> None:
        """Start a node; a plant, once the watchdog of the last one has let the device go."""
        if node == "plant":
            self.started_into_faults = not self.calm
            if self.calm:
                self.wait(
                    lambda: (
                        not any("watchdog.py" in one[2] for one in processes(self.mark).values())
                    ),
                    "the watchdog of a plant that has ended lets go",
                    2 * HANG,
                )
        self.launch(node)
        if node == "plant":
            self.ready()

    def dismiss(self, topic: str) -> None:
        self.node.destroy_publisher(self.rogues.pop(topic))

    def second(self, node: str) -> None:
        """Start a node that already exists: it ends by itself, in order, and says why.

        One that has come before the first was discovered stays, or both end; nothing is driven
        then.
        """
        name = f"second_{node}"
        self.doubled.add(node)
        self.start(node, name=name)
        process = self.crew.processes[name]
        what = f"a second {node}"
        with contextlib.suppress(AssertionError):
            self.wait(lambda: process.poll() is not None or not self.alive(node), what, 2 * HANG)
        if process.poll() is None:
            if self.alive(node):
                self.trigger("reset")
                answer = self.trigger("enable")
                assert answer is None or not answer.success, f"{what} does not end, and is joined"
            process.send_signal(signal.SIGTERM)
            self.wait(lambda: process.poll() is not None, f"{what} ends after SIGTERM")
        elif self.alive(node):
            words = self.crew.last_words(name)
            assert process.poll() == 2, f"{what} ends with status {process.poll()}{words}"
            assert words, f"{what} ends without a word"


class Alone(Lab):
    """The loop in one process, started as a user does: a trip ends it."""

    PROCESSES = ("plant",)

    def process(self, node: str) -> str:
        return "plant"

    def launch(self, node: str) -> None:
        self.asked_to_end.clear()
        self.values.clear()
        self._met.clear()
        self.gate, self.stops, self.unwatched = "", 0, False
        self.felt.held.change(self.first)
        faults.OneProcess.begin(self, "100000")

    def ready(self) -> bool:
        self.wait(lambda: self.gate or not self.alive("plant"), "a started run", START)
        return self.alive("plant")

    def may_end(self, node: str, status: int, words: str) -> bool:
        return self.started_into_faults or (status == 3 and "safety gate has tripped" in self.log())

    def check_states(self) -> None:
        """After a trip it ends by itself."""
        if self.gate == "fault":
            self.wait(lambda: not self.alive("plant"), "the end of a run that has tripped")
            self.check_processes()

    def heal(self) -> None:
        self.mend()
        for rogue in list(self.rogues):
            self.dismiss(rogue)
        if self.values and self.alive("plant"):
            self.end("plant", signal.SIGTERM)
        if not self.alive("plant"):
            self.start_again("plant")


TRANSITIONS = {
    "configure": 1,
    "cleanup": 2,
    "activate": 3,
    "deactivate": 4,
    "unconfigured_shutdown": 5,
    "inactive_shutdown": 6,
    "active_shutdown": 7,
    "destroy": 8,
    "nonsense": 99,
}


# Foreign messages


def joint_state(stamp: int, **more: Any) -> Any:
    from sensor_msgs.msg import JointState

    message = JointState(**more)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    return message


def trajectory(stamp: int, points: int, axis: str, w: float) -> Any:
    from builtin_interfaces.msg import Duration
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

    message = JointTrajectory(joint_names=[axis])
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    for i in range(points):
        one = Duration(sec=0, nanosec=i * 5_000_000)
        message.points.append(
            JointTrajectoryPoint(
                positions=[w], velocities=[0.0], accelerations=[0.0], time_from_start=one
            )
        )
    return message


FAR = (0, 5_000_000, 7, 10**18, -(10**9), 2**31 * 10**9 - 1)
"""Stamps (ns): of a sample, of none, of no loop."""


def foreign(kind: str, stamp: int, which: int, value: float) -> Any:
    """One message of a type that nobody of the loop has sent."""
    from builtin_interfaces.msg import Time
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from rcl_interfaces.msg import ParameterEvent
    from std_msgs.msg import UInt8MultiArray

    if kind == "sensor_msgs/msg/JointState":
        axis = (["x"], ["y"], [], ["x", "y"])[which % 4]
        numbers = [value] * (which % 3)
        return joint_state(stamp, name=axis, position=numbers, velocity=numbers, effort=[value])
    if kind == "trajectory_msgs/msg/JointTrajectory":
        return trajectory(stamp, (0, 1, 3, 2000)[which % 4], "xy"[which % 2], value)
    if kind == "builtin_interfaces/msg/Time":
        sec, nanosec = divmod(stamp, 10**9)
        return Time(sec=sec, nanosec=nanosec)
    if kind == "std_msgs/msg/UInt8MultiArray":
        return UInt8MultiArray(data=bytes((0, 1, 0, 0, 255) * (which % 5)))
    if kind == "rcl_interfaces/msg/ParameterEvent":
        event = ParameterEvent(node=("/pea/plant", "/pea/controller", "", "x")[which % 4])
        event.stamp.sec, event.stamp.nanosec = divmod(stamp, 10**9)
        return event
    pair = KeyValue(key="lost_samples", value=("many", "", "nan", "-1")[which % 4])
    return DiagnosticArray(
        status=[DiagnosticStatus(level=b"\0", name="pea: observer", message="x", values=[pair])]
    )


KINDS = {topic.name: (topic.type, topic.latched) for topic in OWNED} | {
    "/diagnostics": ("diagnostic_msgs/msg/DiagnosticArray", False),
    "/parameter_events": ("rcl_interfaces/msg/ParameterEvent", False),
}


def message_type(kind: str) -> Any:
    """Class of ``package/msg/Type``."""
    package, _, name = kind.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def publisher(lab: Lab, topic: str) -> Any:
    """A publisher of the walk's node that the loop's nodes hear."""
    from rclpy.qos import DurabilityPolicy, QoSProfile

    kind, latched = KINDS[topic]
    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    made = lab.node.create_publisher(
        message_type(kind), topic, QoSProfile(depth=10, durability=durability)
    )
    end = time.monotonic() + 1.0  # not all topics have somebody who listens
    while not made.get_subscription_count() and time.monotonic() < end:
        lab.spin(0.01)
    return made


# The machine


class Course:
    """What all machines of a walk share: the rig, the count, the trace."""

    def __init__(self, there: Path, rig: str, wanted: int, tell: Callable[[str], None]) -> None:
        self.there, self.rig, self.wanted, self.tell = there, rig, wanted, tell
        self.lab: Lab | None = None
        self.kind: type[Lab] = Lab
        self.done = self.labs = 0
        self.trace: list[str] = []
        self.counts: dict[str, int] = {}
        self._taken: dict[str, int] = {}
        self.failed = ""
        self.begun = False
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Course:
        self.device = self._stack.enter_context(contextlib.closing(faults.Emulated(self.rig)))
        return self

    def device_again(self, number: int) -> None:
        """End the emulator, and start another one at the same place, at 0 V."""
        self.device.again(number)
        if (lab := self.lab) is not None:
            lab.felt.control = self.device.control
            lab.felt.last = (time.monotonic_ns(), lab.felt.voltage())

    def __exit__(self, *error: object) -> None:
        self.close()
        self._stack.close()

    def open(self) -> Lab:
        """The rig that runs, or a new one."""
        if self.lab is None:
            self.labs += 1
            self.device.control.clear()
            experiment = faults.loaded(self.device.address, *RATE, name=self.rig)
            there = self.there / f"rig{self.labs}"
            self.lab = self.kind(there, experiment, self.device, None)
        return self.lab

    def turn(self, kind: type[Lab]) -> None:
        """The next rig is of that kind."""
        if kind is not self.kind:
            self.close()
            self.kind = kind

    def close(self) -> None:
        """End the rig."""
        if self.lab is not None:
            lab, self.lab = self.lab, None
            self.device.control.clear()
            lab.close()

    def due(self, name: str, every: int) -> bool:
        """Whether a step that takes seconds is taken: once in so many steps."""
        if self._taken.get(name, 0) * every > self.done:
            return False
        self._taken[name] = self._taken.get(name, 0) + 1
        return True

    def count(self, text: str) -> None:
        """One more step."""
        self.done += 1
        name = text.partition("(")[0]
        self.counts[name] = self.counts.get(name, 0) + 1
        self.trace.append(text)
        self.tell(text)


COURSE: list[Course] = []


def step(act: Callable[..., Any], when: Callable[[Walk], bool] | None = None) -> Callable[..., Any]:
    """A step of the walk: counted, noted, and what must hold is looked at after it.

    Where it cannot be taken it is left out. A precondition of Hypothesis must not say so: what it
    draws would depend on the processes, and it refuses draws that do not repeat.
    """

    @functools.wraps(act)
    def taken(self: Walk, **drawn: Any) -> None:
        course = self.course
        if self.idle or (course.done >= course.wanted and not course.failed):
            return
        if when is not None and not when(self):
            return
        words = ", ".join(f"{name}={value!r}" for name, value in drawn.items())
        course.count(f"{act.__name__}({words})")
        try:
            act(self, **drawn)
            self.lab.check()
            self.lab.age += bool(self.lab.lasting)
            if self.lab.age > AGE:
                self.lab.mend()
        except BaseException as error:
            self.broken = True
            if not course.failed and isinstance(error, Exception):
                course.failed = f"{type(error).__name__}: {error}"
                trace = "\n".join(f"    {one}" for one in course.trace)
                course.tell(f"\nBROKEN at step {course.done}: {course.failed}\n{trace}\n")
            raise

    return taken


def step_when(when: Callable[[Walk], bool]) -> Callable[..., Any]:
    """A step that can be taken only then."""
    return functools.partial(step, when=when)


def plant_lives(self: Walk) -> bool:
    return self.lab.alive("plant")


def four_nodes(self: Walk) -> bool:
    return self.lab.PROCESSES == NODES


def stops(lab: Lab) -> bool:
    """Whether a stop has brought the stage to rest."""
    answer = lab.trigger("stop")
    return answer is None or bool(answer.success)


def managed(self: Walk) -> bool:
    return plant_lives(self) and four_nodes(self)


class Walk(RuleBasedStateMachine):
    """Steps and what they must lead to."""

    broken = False

    def __init__(self) -> None:
        super().__init__()
        self.course = COURSE[-1]
        self.idle, self.course.begun = not self.course.begun, True

    @property
    def lab(self) -> Lab:
        return self.course.open()

    @initialize(which=st.integers(0, ALONE - 1))
    def healthy(self, which: int) -> None:
        """Begin each sequence with a rig that runs, and the parameters of its file."""
        if self.idle or (self.course.done >= self.course.wanted and not self.course.failed):
            return
        self.course.trace.clear()
        try:
            self.course.turn(Lab if which else Alone)
            lab = self.lab
            if self.course.done:
                lab.heal()
            lab.check()
        except BaseException:
            self.broken = True
            raise

    def teardown(self) -> None:
        if self.broken:
            self.course.close()

    # The gate's services and the lifecycle

    @rule()
    @step_when(managed)
    def enable(self) -> None:
        self.lab.trigger("reset")
        self.lab.trigger("enable")

    @rule(name=st.sampled_from(("enable", "stop", "reset")))
    @step_when(plant_lives)
    def call(self, name: str) -> None:
        lab = self.lab
        answer = lab.trigger(name if four_nodes(self) else "stop")
        if name == "stop" and answer is not None:
            assert answer.message
            if not answer.success and lab.calm:  # a device that is off for a while is dialled again
                lab.wait(lambda: not lab.alive("plant") or stops(lab), "a stop that takes effect")

    @rule(label=st.sampled_from([*TRANSITIONS, "activate", "deactivate", "configure"]))
    @step_when(managed)
    def transit(self, label: str) -> None:
        lab = self.lab
        before = lab.lifecycle()
        if label.endswith("_shutdown"):
            lab.asked_to_end.add("plant")
        answer = lab.transit(label)
        if label.endswith("_shutdown"):
            if label == f"{before}_shutdown" and answer is not None and answer.success:
                lab.wait(lambda: not lab.alive("plant"), "the plant ends after shutdown", 2 * HANG)
            elif lab.alive("plant"):
                lab.asked_to_end.discard("plant")

    # Parameters

    @rule(name=st.sampled_from(sorted(TIGHTEN)), share=st.floats(0.0, 1.0))
    @step_when(plant_lives)
    def tighten(self, name: str, share: float) -> None:
        lab = self.lab
        if name == "safety.safe_voltage" and managed(self) and lab.lifecycle() == "unconfigured":
            return  # nobody moves the stage there
        low, high = TIGHTEN[name]
        lab.set("plant", name, round(low + share * (high - low), 3))

    @rule(name=st.sampled_from(sorted(TIGHTEN)), factor=st.sampled_from((1.0, 1.5, 100.0)))
    @step_when(plant_lives)
    def loosen(self, name: str, factor: float) -> None:
        lab = self.lab
        if name == "safety.safe_voltage" or (name, factor) == ("safety.watchdog_s", 100.0):
            return
        value = lab.own(name) * factor
        was, before = lab.values.get(("plant", name), lab.own(name)), lab.told()
        result = lab.set("plant", name, value)
        if before == lab.told() and before[1] == "active" and abs(value) > abs(was):
            assert result is None or not result.successful, f"{name} was loosened while active"

    @rule(law=st.sampled_from(LAWS), which=st.integers(0, 4))
    @step
    def law(self, law: tuple[str, str, tuple[Any, ...]], which: int) -> None:
        node, name, values = law
        if self.lab.alive(node):
            self.lab.set(node, name, values[which % len(values)])

    @rule(node=st.sampled_from(NODES), name=st.sampled_from(NAMES), value=st.sampled_from(NONSENSE))
    @step
    def nonsense(self, node: str, name: str, value: Any) -> None:
        if self.lab.alive(node):
            self.lab.set(node, name, value)

    # Processes

    @rule(
        node=st.sampled_from(NODES),
        number=st.sampled_from((signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT)),
        again=st.booleans(),
    )
    @step
    def end(self, node: str, number: signal.Signals, again: bool) -> None:
        lab = self.lab
        node = lab.process(node)
        if not lab.alive(node):
            lab.start_again(node)
            return
        lab.end(node, number)
        if again:
            lab.check()
            lab.start_again(node)

    @rule(node=st.sampled_from(NODES), seconds=st.sampled_from((0.05, 0.2, 0.7)))
    @step
    def freeze(self, node: str, seconds: float) -> None:
        lab = self.lab
        node = lab.process(node)
        if lab.alive(node):
            lab.signal(node, signal.SIGSTOP)
            try:
                lab.spin(seconds)
            finally:
                lab.signal(node, signal.SIGCONT)

    @rule(node=st.sampled_from(NODES))
    @step
    def again(self, node: str) -> None:
        for each in self.lab.PROCESSES:
            if not self.lab.alive(each):
                self.lab.start_again(each)

    @rule(node=st.sampled_from(NODES))
    @step_when(four_nodes)
    def second(self, node: str) -> None:
        if self.lab.alive(node) and self.course.due("second", 40):
            self.lab.second(node)

    @rule(number=st.sampled_from((signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM, signal.SIGINT)))
    @step_when(plant_lives)
    def watchdog(self, number: signal.Signals) -> None:
        lab = self.lab
        for pid in lab.watchdogs():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)
            if number in (signal.SIGTERM, signal.SIGINT):
                continue  # it does not obey while the plant lives
            lab.unwatched = True

            def replaced(pid: int = pid) -> bool:
                return pid not in lab.watchdogs() or not lab.alive("plant")

            try:
                if lab.calm:
                    lab.wait(replaced, f"the plant has done with a watchdog after {number.name}")
                    lab.wait(
                        lambda: (
                            lab.watchdogs()
                            or lab.gate in ("unconfigured", "")
                            or not lab.alive("plant")
                        ),
                        "a new watchdog",
                    )
                    lab.unwatched = False
            finally:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGCONT)

    # The device

    @rule(text=st.sampled_from(DEVICE))
    @step
    def device(self, text: str) -> None:
        self.lab.inject(text)
        self.lab.spin(0.05)

    @rule(number=st.sampled_from((signal.SIGKILL, signal.SIGTERM)))
    @step
    def device_again(self, number: signal.Signals) -> None:
        if self.course.device.serial or not self.course.due("device_again", 80):
            return
        self.lab.felt.check()
        self.course.device_again(number)
        self.lab.mend()

    @rule()
    @step
    def mend(self) -> None:
        self.lab.mend()

    # Foreign messages

    @rule(
        topic=st.sampled_from(sorted(KINDS)),
        stamp=st.sampled_from(FAR),
        which=st.integers(0, 11),
        value=st.sampled_from((0.0, math.nan, math.inf, 1e-6, 100.0, -1e300)),
        stays=st.booleans(),
    )
    @step
    def message(self, topic: str, stamp: int, which: int, value: float, stays: bool) -> None:
        lab = self.lab
        if topic not in lab.rogues:
            lab.rogues[topic] = publisher(lab, topic)
        for _ in range(1 + which % 3):
            lab.rogues[topic].publish(foreign(KINDS[topic][0], stamp, which, value))
        lab.spin(0.05)
        if not stays:
            lab.dismiss(topic)

    @rule()
    @step
    def leave(self) -> None:
        for topic in list(self.lab.rogues):
            self.lab.dismiss(topic)

    # Time

    @rule(seconds=st.sampled_from((0.05, 0.2, 0.5)))
    @step
    def pause(self, seconds: float) -> None:
        self.lab.spin(seconds)

    @rule()
    @step
    def heal(self) -> None:
        self.lab.heal()


def run(
    steps: int,
    number: int,
    there: Path,
    rig: str,
    tell: Callable[[str], None],
    length: int = LENGTH,
) -> Course:
    """Walk so many steps.

    Raises
    ------
    Exception
        What was broken; Hypothesis' own account of the steps is with it.
    """
    with Course(there, rig, steps, tell) as course:
        COURSE.append(course)
        try:
            while course.done < steps:
                left = steps - course.done
                course.begun = False  # the first sequence is the simplest one, without a surprise
                chosen = settings(
                    max_examples=2 + math.ceil(left / length),  # the first two are the shortest
                    stateful_step_count=1 + min(length, left),
                    phases=[Phase.generate],
                    deadline=None,
                    database=None,
                    report_multiple_bugs=False,
                    print_blob=True,
                    suppress_health_check=list(HealthCheck),
                )
                walk = type("Walk", (Walk,), {})
                run_state_machine_as_test(seed(number)(walk), settings=chosen)
                number += 1
        finally:
            COURSE.pop()
        return course


def several(arguments: argparse.Namespace, number: int) -> int:
    """Walk in several processes at once, each on a rig of its own, from the next seeds."""
    from pea_core.console import bar, err

    jobs, walkers, status = arguments.jobs, [], 0
    with tempfile.TemporaryDirectory() as told, bar(err) as progress:
        for i in range(jobs):
            steps = arguments.steps * (i + 1) // jobs - arguments.steps * i // jobs
            command = [sys.executable, __file__, "--steps", str(steps), "--rig", arguments.rig]
            out = open(Path(told) / str(i), "w+b")  # noqa: SIM115  to the end of the walker
            walker = subprocess.Popen(
                [*command, "--seed", str(number + i)], stdout=out, stderr=subprocess.STDOUT
            )
            task = progress.add_task(f"seed {number + i}", total=steps)
            walkers.append((walker, out, task))
        try:
            while any(walker.poll() is None for walker, *_ in walkers):
                for _, out, task in walkers:
                    done = COUNTED.findall(os.pread(out.fileno(), 1 << 20, 0))
                    progress.update(task, completed=int(done[-1]) if done else 0)
                time.sleep(0.5)
        finally:
            for walker, *_ in walkers:
                walker.terminate()
                walker.wait()
        for walker, out, _ in walkers:
            status |= walker.returncode
            print(os.pread(out.fileno(), 1 << 20, 0).decode(errors="replace"))
    return status


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--steps", type=int, default=STEPS, help=f"default: {STEPS}")
    parser.add_argument("--seed", type=int, default=None, help="of a walk before (default: any)")
    parser.add_argument("--jobs", type=int, default=1, help="processes that share them")
    parser.add_argument("--rig", default=faults.RIG, help=f"emulated (default: {faults.RIG})")
    arguments = parser.parse_args()
    number = secrets.randbelow(2**32) if arguments.seed is None else arguments.seed
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # the nodes end with the walk
    if arguments.jobs > 1:
        return several(arguments, number)
    there = Path(tempfile.mkdtemp(prefix="pea_walk_"))
    print(f"seed {number}; logs in {there}", flush=True)
    began, live, told = time.monotonic(), sys.stdout.isatty(), [0]
    steps = open(there / "steps.txt", "w", buffering=1)  # noqa: SIM115  to the end of the process

    def tell(text: str) -> None:
        steps.write(f"{time.monotonic() - began:.2f} s: {text}\n")
        if text.startswith("\nBROKEN"):
            print(text, flush=True)
            return
        told[0] += 1
        done, total = told[0], arguments.steps
        if live or not done % 100 or done == total:
            filled = min(40 * done // total, 40)
            line = f"[{'#' * filled:40}] {done}/{total} {time.monotonic() - began:.0f} s"
            print(f"\r{line}  {text[:60]:60}" if live else line, end="" if live else "\n")
            sys.stdout.flush()

    try:
        course = run(arguments.steps, number, there, arguments.rig, tell)
    except Exception as error:
        import traceback

        traceback.print_exception(error)
        print(f"the same walk: --seed {number} --steps {arguments.steps}; logs in {there}")
        return 1
    counts = ", ".join(f"{n} {name}" for name, n in sorted(course.counts.items()))
    print(f"\n{course.done} steps in {time.monotonic() - began:.0f} s, nothing broken: {counts}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
