"""Every fault of the table in docs/reliability.md, injected into a loop that runs on an emulator.

``.ci/env python tests/faults.py [--write] [ROW ...]``, or ``make faults``. Ends with status 1
where a voltage or a slew limit was broken, a reason is missing, or the stage did not come to rest.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import math
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from pea_core import config
from pea_core.config import NODES
from pea_drivers.emulator import Control
from pea_engine import pace
from pea_experiment import experiments, rig
from pea_experiment.experiment import Experiment
from pea_run.modes.distributed import Crew, environment

RIG = "e727_200hz_emulated"
EXPERIMENT = "fig9_hysteresis_10hz"
SETS = ("reference.frequency_hz=1",)
PAGE = Path(__file__).resolve().parents[1] / "docs" / "reliability.md"
BEGIN, END = "<!-- faults: begin -->", "<!-- faults: end -->"

HIGH = 30.0
"""Voltage (V) above which a fault is injected: the way down is then worth looking at."""

PATIENCE = 30.0
TIGHT, TIGHT_FAST = 300.0, 5e4
"""A slew limit (V/s) below the rig's, above what the sine and the sensor's noise need."""

REST = 0.1
"""Volts from the safe voltage that count as there: a DAC has steps."""

LIBRARY = Path(__file__).with_name("spoilt.c")
"""A driver's library that goes wrong at SIGUSR1, as `SPOIL` says."""

SPOIL = "PEA_SPOIL"
"""Environment variable that tells a stand-in what to do when it gets SIGUSR1."""


def spoil(what: str, u: float) -> float:
    """Command (V) of a controller that has gone wrong."""
    ramp = {"+1e6 V/s": 5e3, "-1e6 V/s": -5e3}
    return u + ramp[what] if what in ramp else float(what.removesuffix(" V"))


def stand_in(node: str) -> None:
    """Run a node that goes wrong at SIGUSR1, and says when."""
    what, gone = os.environ[SPOIL], []

    def now_wrong(number: int, frame: object) -> None:
        gone.append(time.monotonic_ns())

    signal.signal(signal.SIGUSR1, now_wrong)
    if node == "controller":
        from pea_controller import node as controller
        from pea_wire import convert

        right = convert.forms().voltage.encode

        def encode(stamp: int, u: float) -> bytes:
            if gone:
                if len(gone) == 1:
                    gone.append(time.monotonic_ns())
                    print(f"spoilt {gone[-1]}", flush=True)
                u = spoil(what, u)
            return right(stamp, u)

        convert.forms().voltage.encode = encode
        controller.main()
    else:
        from pea_engine import pace
        from pea_plant import node as plant

        usual = pace.now

        def now() -> int:
            return usual() + (int(float(what) * 1e9) if gone else 0)

        pace.now = now
        plant.main()


def hasty() -> Callable[[], None] | None:
    """What lets a process go before others, where this one does not already.

    A priority that is inherited is that of its middleware's threads, too.
    """
    return None if os.sched_getscheduler(0) in (os.SCHED_FIFO, os.SCHED_RR) else pace.hurry


def monotonic(sec: str, nanosec: str) -> int:
    """Monotonic clock (ns) of a stamp in a log."""
    return int(sec) * 10**9 + int(nanosec) - time.time_ns() + time.monotonic_ns()


class Loop:
    """Four nodes on the emulator, started for one row.

    Parameters
    ----------
    there : Path
        Directory for logs.
    experiment : Experiment
    device : Emulated
        The emulator.
    spoilt : tuple of str
        A node to stand in for, and what it does wrong.
    """

    def __init__(
        self, there: Path, experiment: Experiment, device: Emulated, spoilt: tuple[str, str] | None
    ) -> None:
        self.device, self.experiment = device, experiment
        self.before: list[list[tuple[int, float]]] = []
        self.spoilt = spoilt
        self.executor: Any = None
        self.rogues: list[Any] = []
        self._clients: dict[str, Any] = {}
        self._stack = contextlib.ExitStack()
        env, held = self._stack.enter_context(environment())
        self.env = {**env, "PYTHONUNBUFFERED": "1"}
        if not sampled(self):
            self.env["PEA_COMPILE"] = "0"
        self.crew = Crew(there / "log", self.env, held)
        params = there / "params.yaml"
        sections = experiment.sections()
        config.write(params, {node: sections[node] for node in NODES})
        self.arguments = ("--ros-args", "--params-file", str(params))
        self.began, self.limit = time.monotonic_ns(), 0.0
        self.begin()

    @property
    def control(self) -> Control:
        """Control channel of the emulator that runs."""
        return self.device.control

    def history(self) -> list[list[tuple[int, float]]]:
        """Every command of each channel since the loop began, of an emulator before as well."""
        found = [self.control.since(self.began, name) for name in self.device.channels]
        return [
            [*before, *own]
            for before, own in itertools.zip_longest(self.before, found, fillvalue=())
        ]

    def begin(self) -> None:
        """Start what the loop consists of."""
        for node in NODES:
            self.start(node)

    def start(self, node: str, *arguments: str, name: str = "") -> None:
        """Start a node, or its stand-in."""
        if self.spoilt is None or self.spoilt[0] != node:
            command = [*self.command(node), *self.arguments, *arguments]
            env = self.env
        else:
            command = [sys.executable, __file__, "--as", node, *self.arguments]
            env = {**self.env, SPOIL: self.spoilt[1]}
        with open(self.crew.log / f"{name or node}.log", "ab") as log:
            self.crew.processes[name or node] = subprocess.Popen(
                command,
                env={**env, "ROS_LOG_DIR": str(self.crew.log)},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                pass_fds=self.crew.held,
                preexec_fn=hasty(),
            )

    @staticmethod
    def command(node: str) -> list[str]:
        from pea_run.modes.distributed import executable

        return [str(executable(node))]

    def log(self, node: str = "plant") -> str:
        return (self.crew.log / f"{node}.log").read_text(errors="replace")

    def signal(self, node: str, number: int) -> int:
        """Signal a node; monotonic clock (ns) before."""
        t = time.monotonic_ns()
        self.crew.processes[node].send_signal(number)
        return t

    def voltage(self) -> float:
        """Voltage (V) that the device has; of several channels the one that is farthest from 0."""
        log = self.control.log()
        last = [own["last_voltage_V"] for own in log.get("axes", {"": log}).values()]
        return max((one["value"] for one in last if one), key=abs, default=0.0)

    def until(self, true: Callable[[], Any], what: str) -> Any:
        end = time.monotonic() + PATIENCE
        while not (found := true()):
            if time.monotonic() > end:
                raise TimeoutError(f"{what} never came; plant: {self.log()[-1500:]}")
            time.sleep(0.02)
        return found

    def run_in(self) -> None:
        """Wait until the loop tracks, with some voltage to come down from."""
        self.until(lambda: "inactive -> active" in self.log(), "the gate to open")
        time.sleep(1.0)
        self.until(lambda: self.voltage() > HIGH or TRIP.search(self.log()), "a high voltage")
        if early := self.tripped():
            raise TimeoutError(f"tripped before the fault: {early}")

    def tripped(self) -> str:
        """Why it has tripped, if it has."""
        found = TRIP.search(self.log())
        return found[3] if found else ""

    def fault(self) -> tuple[int, str]:
        """Monotonic clock (ns) of the trip, and its cause."""
        found = self.until(lambda: TRIP.search(self.log()), "a trip")
        sec, nanosec, cause = found.groups()
        return monotonic(sec, nanosec), cause

    def client(self, name: str) -> Any:
        """Client of a service of the plant; the service is there."""
        import rclpy
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
        from std_srvs.srv import Trigger

        if self.executor is None:
            for variable in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE"):
                os.environ[variable] = self.env[variable]
            context = Context()
            rclpy.init(context=context, domain_id=int(self.env["ROS_DOMAIN_ID"]))
            self.executor = SingleThreadedExecutor(context=context)
            self._stack.callback(rclpy.shutdown, context=context)
            self.node = Node("_faults", context=context)
            self._stack.callback(self.node.destroy_node)
            self.executor.add_node(self.node)
            self._stack.callback(self.executor.shutdown)
        if name not in self._clients:
            self._clients[name] = self.node.create_client(Trigger, f"/pea/plant/{name}")
        assert self._clients[name].wait_for_service(PATIENCE), name
        return self._clients[name]

    def call(self, name: str) -> int:
        """Call a service of the plant; monotonic clock (ns) before."""
        from std_srvs.srv import Trigger

        client = self.client(name)
        t = time.monotonic_ns()
        future = client.call_async(Trigger.Request())
        self.executor.spin_until_future_complete(future, PATIENCE)
        answer = future.result()
        assert answer is not None, name
        assert answer.success, f"~/{name}: {answer.message}"
        return t

    def go_on_after(self, reason: str) -> None:
        """Continue a stopped plant, and see why it has tripped."""
        self.signal("plant", signal.SIGCONT)
        assert self.fault()[1].startswith(reason), self.log()

    mended = "; after ~/reset and ~/enable it tracks again"

    def again(self) -> None:
        """Reset and enable, as soon as that is possible; wait until it tracks.

        A lost device is first reached again, a killed controller forgotten. Up, down and up again
        is a period of the reference at least.
        """

        def accepted(name: str) -> bool:
            try:
                return bool(self.call(name))
            except AssertionError as error:
                if "publishers" in str(error) or "tried again" in str(error):
                    return False
                raise

        for name in ("reset", "enable"):
            self.until(lambda name=name: accepted(name), name)
        for way in (1.0, -1.0, 1.0):
            self.until(lambda way=way: way * (self.voltage() - HIGH) > 0.0, "tracking")
        trips = TRIP.findall(self.log())
        assert len(trips) == 1, trips

    def close(self) -> None:
        for process in self.crew.processes.values():
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
        self.crew.end()
        self._stack.close()


class OneProcess(Loop):
    """The same in one process, started as a user does; it ends at a trip."""

    def begin(self, duration: str = "120") -> None:
        there = self.crew.log / "params.yaml"
        config.write(there, self.experiment.sections())
        command = [sys.executable, "-m", "pea_cli.cli", "run", str(there)]
        command += ["--mode", "composed", "--clock", "wall", "--no-record", "--duration", duration]
        with open(self.crew.log / "plant.log", "ab") as log:
            self.crew.processes["plant"] = subprocess.Popen(
                [*command, "--out", tempfile.mkdtemp(dir=self.crew.log) + "/run"],
                env=self.env if self.spoilt is None else {**self.env, SPOIL: self.spoilt[1]},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                pass_fds=self.crew.held,
                preexec_fn=hasty(),
            )

    def run_in(self) -> None:
        self.until(lambda: self.voltage() > HIGH or END_OF_RUN.search(self.log()), "a voltage")
        if early := self.tripped():
            raise TimeoutError(f"ended before the fault: {early}")

    def tripped(self) -> str:
        found = END_OF_RUN.search(self.log())
        return found[1] if found else ""

    def fault(self) -> tuple[int, str]:
        found = self.until(lambda: END_OF_RUN.search(self.log()), "a trip")
        return time.monotonic_ns(), found[1]

    mended = "; the run ends with status 3"

    def again(self) -> None:
        """The run has ended; the next one begins by hand."""
        assert self.crew.processes["plant"].wait(PATIENCE) == 3


END_OF_RUN = re.compile(r"pea: the safety gate has tripped: (.*)")
TRIP = re.compile(r"\[ERROR\] \[(\d+)\.(\d+)\] \[pea\.plant\]: \w+ -> fault: (.*)")
WATCHDOG = re.compile(r"watchdog: (the plant (?:has died|is silent for [\d.]+ s): from .*)")


class Found(NamedTuple):
    """One row of the table; times in ms, voltages in V, slew in V/s."""

    fault: str
    cause: str
    detected: float
    peak: float
    slew: float
    safe: float
    broken: str


def kill(node: str, number: int = signal.SIGKILL) -> Callable[[Loop], int]:
    return lambda loop: loop.signal(node, number)


def inject(text: str) -> Callable[[Loop], int]:
    return lambda loop: loop.control.fault(text)


def wrong(node: str) -> Callable[[Loop], int]:
    def act(loop: Loop) -> int:
        t = loop.signal(node, signal.SIGUSR1)
        if node == "plant":
            return t
        found = loop.until(lambda: re.search(r"spoilt (\d+)", loop.log(node)), "a wrong command")
        return int(found[1])

    return act


def restart(node: str) -> Callable[[Loop], int]:
    def act(loop: Loop) -> int:
        t = loop.signal(node, signal.SIGKILL)
        loop.crew.processes[node].wait()
        loop.start(node)
        return t

    return act


def go_on(loop: Loop) -> None:
    loop.signal("controller", signal.SIGCONT)


def as_it_is(loop: Loop) -> None:
    pass


def watchdog_of(pid: int) -> int:
    """Process of the watchdog that a plant has started."""
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            parent = int(stat.read_text().rpartition(")")[2].split()[1])
            if parent == pid and b"watchdog.py" in stat.with_name("cmdline").read_bytes():
                return int(stat.parent.name)
    raise AssertionError(f"process {pid} has no watchdog")


def without_watchdog(number: int) -> Callable[[Loop], int]:
    """Signal the watchdog alone."""

    def act(loop: Loop) -> int:
        pid = watchdog_of(loop.crew.processes["plant"].pid)
        t = time.monotonic_ns()
        os.kill(pid, number)
        return t

    return act


def refusing(loop: Loop) -> int:
    """The device refuses for half a second, and meanwhile the plant is killed."""
    loop.control.fault("refuse")
    loop.control.fault("drop")
    t = loop.signal("plant", signal.SIGKILL)
    time.sleep(0.5)
    loop.control.clear()
    return t


def set_plant(loop: Loop, name: str, value: float) -> Any:
    """Set a parameter of the plant; what it answers."""
    from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
    from rcl_interfaces.srv import SetParameters

    loop.client("stop")
    client = loop.node.create_client(SetParameters, "/pea/plant/set_parameters")
    assert client.wait_for_service(PATIENCE)
    value_of = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
    wanted = Parameter(name=name, value=value_of)
    future = client.call_async(SetParameters.Request(parameters=[wanted]))
    loop.executor.spin_until_future_complete(future, PATIENCE)
    assert future.result() is not None, "set_parameters does not answer"
    return future.result().results[0]


def tightened(loop: Loop) -> int:
    """The slew limit is tightened, then the plant is killed."""
    tight = TIGHT_FAST if sampled(loop) else TIGHT
    result = set_plant(loop, "safety.slew_rate", tight)
    assert result.successful, result.reason
    loop.limit = tight
    loop.began = time.monotonic_ns()
    loop.until(lambda: loop.voltage() > HIGH, "a high voltage")
    return loop.signal("plant", signal.SIGKILL)


def safe_voltage(loop: Loop) -> int:
    """The safe voltage is set to 100 V, which is refused; then an emergency stop."""
    result = set_plant(loop, "safety.safe_voltage", 100.0)
    assert not result.successful, "safety.safe_voltage was changed while active"
    loop.until(lambda: loop.voltage() > HIGH, "a high voltage")
    return loop.call("stop")


def watchdog_then_plant(loop: Loop) -> int:
    """The watchdog is killed, and the plant once the stage is safe."""
    t = without_watchdog(signal.SIGKILL)(loop)
    loop.fault()
    loop.until(lambda: abs(loop.voltage()) < REST, "the safe voltage")
    loop.signal("plant", signal.SIGKILL)
    return t


def watchdog_and_socket(loop: Loop) -> int:
    """The watchdog is stopped, and the connection cut."""
    t = without_watchdog(signal.SIGSTOP)(loop)
    loop.control.fault("drop")
    return t


def dripping(act: Callable[[Loop], int]) -> Callable[[Loop], int]:
    """What is done while each answer comes byte by byte."""

    def during(loop: Loop) -> int:
        loop.control.fault("drip=0.05")
        time.sleep(0.1)
        return act(loop)

    return during


def stop_dripping(loop: Loop) -> int:
    """Whatever an emergency stop then tells, it answers."""
    from std_srvs.srv import Trigger

    client = loop.client("stop")
    t = time.monotonic_ns()
    future = client.call_async(Trigger.Request())
    loop.executor.spin_until_future_complete(future, PATIENCE)
    assert future.result() is not None, "~/stop does not answer"
    return t


def start_dripping(loop: Loop) -> int:
    """The plant is killed, and the next one ends when connecting takes too long."""
    t = loop.signal("plant", signal.SIGKILL)
    loop.until(lambda: WATCHDOG.search(loop.log()), "the watchdog")
    time.sleep(0.5)
    loop.start("plant", name="next_plant")
    status = loop.crew.processes["next_plant"].wait(PATIENCE)
    assert status == 2, f"a plant that cannot connect ends with status {status}"
    loop.control.clear()
    return t


KINDS = {
    "voltage": "JointState",
    "state": "JointState",
    "displacement": "JointState",
    "reference": "JointTrajectory",
}


def message(topic: str, stamp: int = 0, **fields: Any) -> Any:
    """A message for a topic of the loop."""
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

    if KINDS[topic] == "JointState":
        made = JointState(**{"name": ["x"], "effort": [100.0], **fields})
    else:
        point = JointTrajectoryPoint(positions=[1e-5], velocities=[0.0], accelerations=[0.0])
        made = JointTrajectory(**{"joint_names": ["x"], "points": [point], **fields})
    made.header.stamp.sec, made.header.stamp.nanosec = divmod(stamp, 10**9)
    return made


def rogue(loop: Loop, topic: str) -> Any:
    """A publisher that does not belong there."""
    loop.client("stop")  # its node is there
    made = loop.node.create_publisher(type(message(topic)), f"/pea/{topic}", 10)
    loop.rogues.append(made)
    return made


def also(topic: str, stamp: int = 0, **fields: Any) -> Callable[[Loop], int]:
    """Somebody else publishes a topic, once."""

    def act(loop: Loop) -> int:
        t = time.monotonic_ns()
        rogue(loop, topic).publish(message(topic, stamp, **fields))
        return t

    return act


def flood(loop: Loop) -> int:
    """Three others publish large messages as fast as they can, for a second."""
    large = message("voltage", effort=[0.0] * 100_000)
    loop.client("stop")
    t = time.monotonic_ns()
    others = [rogue(loop, "voltage") for _ in range(3)]
    while time.monotonic_ns() < t + 10**9:
        for other in others:
            other.publish(large)
    return t


def nonsense(loop: Loop) -> int:
    """Messages of no sense on each topic of the loop."""
    t = time.monotonic_ns()
    for topic, bad in (
        ("voltage", {"name": ["y"]}),
        ("state", {"name": []}),
        ("displacement", {"effort": []}),
        ("reference", {"points": []}),
    ):
        rogue(loop, topic).publish(message(topic, 7, **bad))
    return t


def dismiss(loop: Loop) -> None:
    """Those who do not belong there leave."""
    while loop.rogues:
        loop.node.destroy_publisher(loop.rogues.pop())


def transit(loop: Loop, number: int) -> bool:
    """Ask the plant for a lifecycle transition; whether it was made."""
    from lifecycle_msgs.msg import Transition
    from lifecycle_msgs.srv import ChangeState

    loop.client("stop")
    client = loop.node.create_client(ChangeState, "/pea/plant/change_state")
    assert client.wait_for_service(PATIENCE)
    future = client.call_async(ChangeState.Request(transition=Transition(id=number)))
    loop.executor.spin_until_future_complete(future, PATIENCE)
    assert future.result() is not None, "change_state does not answer"
    return bool(future.result().success)


def cleaned_up(loop: Loop) -> int:
    """Deactivated and cleaned up; a second cleanup is refused, and nothing reconnects."""
    t = time.monotonic_ns()
    assert transit(loop, 4), "deactivate is refused"
    loop.until(lambda: transit(loop, 2), "cleanup")
    assert not transit(loop, 2), "a second cleanup is accepted"
    after = time.monotonic_ns()
    time.sleep(1.0)
    assert not loop.control.since(after), "commanded while unconfigured"
    assert loop.crew.processes["plant"].poll() is None, "a second cleanup ends the plant"
    return t


def endured(text: str) -> Callable[[Loop], int]:
    """A fault that the loop bears for a second; then an emergency stop."""

    def act(loop: Loop) -> int:
        loop.control.fault(text)
        time.sleep(1.0)
        if early := loop.tripped():
            raise AssertionError(f"does not bear {text}: {early}")
        return loop.call("stop")

    return act


def device_killed(loop: Loop) -> int:
    """The device is killed; another one takes its place once the run has ended."""
    loop.before = loop.history()
    t = time.monotonic_ns()
    loop.device.end(signal.SIGKILL)
    loop.fault()
    loop.device.start_again()
    return t


def pull(loop: Loop) -> int:
    t = loop.control.fault("pull")
    time.sleep(0.6)
    loop.control.clear()  # the cable is back
    return t


def no_number(loop: Loop) -> int:
    """A sample is no number; a loop that asks for the newest now and then may have to be lucky."""
    end = time.monotonic() + PATIENCE
    while True:
        t = loop.control.fault("garbage")
        if sampled(loop):  # it takes each
            return t
        again = time.monotonic() + 0.03
        while time.monotonic() < again:
            if loop.tripped():
                return t
            time.sleep(0.002)
        if time.monotonic() > end:
            return t


LATE = (
    *("following_error", "displacement_range", "sensor_jump"),
    *("command_range", "command_slew", "command_stale"),
)
"""What a loop trips with that is unstable as its samples are late, or are lost."""

STILL = ("driver", "sensor_stuck")
"""What a device trips with that gives no sample any more; a card's last one can be read again."""

JUMPED = ("sensor_jump", "command_range")
"""What a loop at 20 kHz trips with: the gate sees the jump and what a law makes of it at once."""

OVERRUN = ("controllers", "command_stale", "clock")
"""What a flood trips with: who publishes, or what it leaves no processor for."""


class Row(NamedTuple):
    """One fault.

    what : in words.  act : injects it; monotonic clock (ns) before.  reason : how the cause of
    the trip must begin.  spoilt : a node to stand in for, and what it does wrong.  mend : what is
    done before ~/reset and ~/enable, after which it must track again; None: it cannot.  sets :
    more ``--set``.
    """

    what: str
    act: Callable[[Loop], int]
    reason: str | tuple[str, ...]
    spoilt: tuple[str, str] | None = None
    mend: Callable[[Loop], None] | None = None
    sets: tuple[str, ...] = ()


def library(what: str, how: str, reason: str) -> Row:
    """The library of a compiled driver goes wrong within an exchange."""
    return Row(
        f"within an exchange the library {what}",
        kill("plant", signal.SIGUSR1),
        reason,
        ("plant", how),
        as_it_is if reason == "silent" else None,
        ("plant.driver.type=native", f"plant.driver.library={LIBRARY}"),
    )


ROWS = {
    **{
        f"command {what}": Row(f"command {what}", wrong("controller"), reason, ("controller", what))
        for what, reason in {
            "nan": "command_not_finite",
            "+inf": "command_not_finite",
            "-inf": "command_not_finite",
            "+1e9 V": "command_range",
            "-1e9 V": "command_range",
            "+1e6 V/s": "command_range",
            "-1e6 V/s": "command_range",
        }.items()
    },
    "controller killed": Row("controller killed (-9)", kill("controller"), "command_stale"),
    "controller stopped": Row(
        "controller stopped (SIGSTOP), then continued",
        kill("controller", signal.SIGSTOP),
        "command_stale",
        mend=go_on,
    ),
    "controller restarted": Row(
        "controller killed and restarted", restart("controller"), "command_stale", mend=as_it_is
    ),
    "two controllers": Row(
        "a second controller publishes", also("voltage"), "controllers", mend=dismiss
    ),
    "two references": Row(
        "a second reference publishes", also("reference"), "controllers", mend=dismiss
    ),
    "two observers": Row("a second observer publishes", also("state"), "controllers", mend=dismiss),
    "two plants": Row(
        "a second plant publishes", also("displacement"), "controllers", mend=dismiss
    ),
    "far stamp": Row(
        "a command of the far future",
        also("voltage", 2**31 * 10**9 - 1),
        "controllers",
        mend=dismiss,
    ),
    "flood": Row("three publishers of 0.8 MB messages, 1 s", flood, OVERRUN, mend=dismiss),
    "nonsense": Row("messages of no sense on each topic", nonsense, "controllers"),
    "cleaned up": Row("deactivate, cleanup, cleanup", cleaned_up, "released"),
    "safe voltage": Row(
        "safe_voltage set to 100 V, then ~/stop", safe_voltage, "emergency_stop", mend=as_it_is
    ),
    "observer killed": Row("observer killed (-9)", kill("observer"), "command_stale"),
    "observer restarted": Row(
        "observer killed and restarted", restart("observer"), "command_stale", mend=as_it_is
    ),
    "plant killed": Row("plant killed (-9)", kill("plant"), "dead"),
    "plant stopped": Row(
        "plant stopped (SIGSTOP), then continued",
        kill("plant", signal.SIGSTOP),
        "silent",
        mend=lambda loop: loop.go_on_after("watchdog"),
    ),
    "refused": Row("plant killed, the device refuses for 0.5 s", refusing, "dead"),
    "limit tightened": Row("slew limit tightened, then plant killed", tightened, "dead"),
    "watchdog killed": Row(
        "watchdog killed (-9)", without_watchdog(signal.SIGKILL), "watchdog", mend=as_it_is
    ),
    "watchdog stopped": Row(
        "watchdog stopped (SIGSTOP)", without_watchdog(signal.SIGSTOP), "watchdog", mend=as_it_is
    ),
    "watchdog, then plant": Row("watchdog killed, then the plant", watchdog_then_plant, "watchdog"),
    "watchdog and socket": Row(
        "watchdog stopped, socket cut", watchdog_and_socket, "driver", mend=as_it_is
    ),
    "slow device": Row(
        "each answer takes 0.25 s",
        inject("delay=0.25"),
        "clock",
        mend=lambda loop: loop.control.clear(),
    ),
    "dripping device": Row(
        "each answer comes byte by byte, 50 ms apart",
        inject("drip=0.05"),
        "driver",
        mend=lambda loop: loop.control.clear(),
    ),
    "dripping, stop": Row(
        "~/stop while answers come byte by byte",
        dripping(stop_dripping),
        "",
        mend=lambda loop: loop.control.clear(),
    ),
    "dripping, SIGTERM": Row(
        "SIGTERM while answers come byte by byte",
        dripping(kill("plant", signal.SIGTERM)),
        "ended",
    ),
    "dripping, SIGINT": Row(
        "SIGINT while answers come byte by byte", dripping(kill("plant", signal.SIGINT)), "ended"
    ),
    "dripping, started": Row(
        "plant killed and started while answers come byte by byte",
        dripping(start_dripping),
        "dead",
    ),
    "babbling device": Row(
        "each answer is repeated without end",
        inject("babble"),
        "driver",
        mend=lambda loop: loop.control.clear(),
    ),
    "plant ended": Row("plant ended (SIGTERM)", kill("plant", signal.SIGTERM), "ended"),
    "socket cut": Row("socket cut", inject("drop"), "driver", mend=as_it_is),
    "cable pulled": Row("cable out for 0.6 s, in the middle of a reply", pull, "driver"),
    "garbage": Row("garbage in place of a reply", inject("garbage"), "driver"),
    "error 10": Row("device says error 10", inject("error=10"), "driver"),
    "error 79": Row("device says error 79", inject("error=79"), "driver"),
    "sensor stuck": Row("sensor stuck", inject("stuck"), "sensor_stuck"),
    "sensor jump": Row("sensor jumps by 5 um", inject("jump=5"), JUMPED),
    "clock jump": Row("clock jumps by 5 s", wrong("plant"), "clock", ("plant", "5")),
    "emergency stop": Row(
        "emergency stop, ~/stop", lambda loop: loop.call("stop"), "emergency_stop", mend=as_it_is
    ),
    "silent": Row("silent", inject("mute"), STILL),
    "killed": Row("killed (-9)", device_killed, STILL),
    "late": Row("each sample comes 0.25 s late", inject("delay=0.25"), STILL),
    "later": Row("each sample comes 5 ms late", inject("delay=0.005"), LATE),
    "half lost": Row(
        "half of the frames lost, either way, for 1 s; then ~/stop",
        endured("lose=50"),
        "emergency_stop",
    ),
    "most lost": Row("nine of ten frames lost, either way", inject("lose=90"), LATE),
    "babbling": Row(
        "each answer is repeated without end, for 1 s; then ~/stop",
        endured("babble"),
        "emergency_stop",
    ),
    "torn": Row("from now on each sample breaks off in the middle", inject("pull"), STILL),
    "torn once": Row(
        "some samples break off in the middle; 1 s later ~/stop",
        endured("truncate"),
        "emergency_stop",
    ),
    "no number": Row("a sample is no number", no_number, "sensor_not_finite"),
    "library crashes": library("crashes (SIGSEGV)", "crash", "dead"),
    "library aborts": library("aborts", "abort", "dead"),
    "library ends": library("ends the process, exit(0)", "exit", "dead"),
    "library hangs": library("hangs", "hang", "silent"),
    "library spins": library("goes round and round", "spin", "silent"),
    "library pauses": library("hangs for 1 s", "pause", "silent"),
    "library refuses": library("refuses the command", "refuse", "driver"),
    "library lies": library("says that NaN is applied", "lie", "driver"),
}


IN_ONE_PROCESS = (
    *("plant killed", "plant stopped", "refused", "watchdog killed", "watchdog stopped"),
    *("limit tightened", "safe voltage", "watchdog and socket"),
    *("dripping, stop", "dripping, SIGTERM", "dripping, SIGINT"),
    *(
        "slow device",
        "dripping device",
        "babbling device",
        "plant ended",
        "socket cut",
        "cable pulled",
        "garbage",
        "error 10",
    ),
    *("sensor stuck", "sensor jump", "emergency stop"),
)
"""Rows that a loop in one process has, too."""


RIGS = {
    RIG: "",
    "nv200_serial_emulated": "NV200",
    "labjack_t7_emulated": "LabJack T7",
    "board_emulated": "board over UDP",
    "registers_emulated": "registers",
    "e727_xy_emulated": "two axes",
}
"""Emulated rigs, and how the rows of the table begin that are not of the first one."""

_OF_A_BOARD = (
    *("plant killed", "plant stopped", "plant ended", "watchdog killed", "watchdog stopped"),
    *("limit tightened", "safe voltage", "sensor stuck", "sensor jump", "emergency stop"),
    *("silent", "killed", "late", "later", "half lost", "most lost", "torn", "torn once"),
    "no number",
)

_OF_A_BOARD_OVER_THE_GRAPH = (
    *("command nan", "controller killed", "two controllers", "plant killed", "plant stopped"),
    *("no number", "silent", "killed", "late", "sensor stuck", "emergency stop"),
)

OVER_THE_GRAPH = {
    "e727_xy_emulated": (
        *("plant killed", "plant stopped", "controller killed", "two controllers"),
        *("socket cut", "sensor jump", "emergency stop"),
    ),
    "board_emulated": _OF_A_BOARD_OVER_THE_GRAPH,
    "registers_emulated": _OF_A_BOARD_OVER_THE_GRAPH,
}
"""Rows of the four nodes on rigs of `IN_PROCESS`."""

IN_PROCESS = {
    "e727_xy_emulated": (
        *("plant killed", "plant stopped", "plant ended", "refused"),
        *("watchdog killed", "watchdog stopped", "limit tightened", "safe voltage"),
        *("slow device", "babbling device", "socket cut", "cable pulled", "garbage", "error 10"),
        *("sensor stuck", "sensor jump", "emergency stop"),
    ),
    "board_emulated": (
        *_OF_A_BOARD,
        "babbling",
        *(name for name in ROWS if name.startswith("library ")),
    ),
    "registers_emulated": _OF_A_BOARD,
}
"""Rigs with several axes or a compiled driver, and their rows in one process."""

FAST = ("board_emulated", "registers_emulated")
"""Rigs at a rate that four nodes do not hold."""

SLOWLY = ("--set", "period_us=500")
"""Their board beside four nodes: ten samples for each of the loop."""

WITHOUT = {
    "nv200_serial_emulated": (
        "socket cut",
        "watchdog and socket",
        "refused",
        "error 10",
        "error 79",
    ),
    "labjack_t7_emulated": ("error 10", "error 79", "babbling device"),
}
"""Rows that a device does not have: a serial line is no socket, an error has codes of its own, an
answer that comes again is known by its number, and left out: see `NUMBERED`."""

NUMBERED = ("labjack_t7_emulated",)
"""Rigs that go on while each answer is repeated."""


LOOSER = {
    "nv200_serial_emulated": ("plant.safety.stale_samples=40",),
    "labjack_t7_emulated": ("plant.safety.stale_samples=100",),
}
"""What a rig has besides: 0.2 s of silence here, as the first one; its own 50 and 20 ms trip on a
busy machine before anything is injected."""


def rows_of(on: str, kind: type[Loop]) -> list[str]:
    """Rows of a rig, in the four nodes or in one process."""
    if on in IN_PROCESS:
        return list((IN_PROCESS if kind is OneProcess else OVER_THE_GRAPH).get(on, ()))
    of_boards = {name for names in IN_PROCESS.values() for name in names} - {*IN_ONE_PROCESS}
    names = IN_ONE_PROCESS if kind is OneProcess else [n for n in ROWS if n not in of_boards]
    without = WITHOUT.get(on, ())
    return [name for name in names if name not in without] + ["babbling"] * (on in NUMBERED)


def steepest(history: list[tuple[int, float]], T_s: float, sampled: bool = False) -> float:
    """Largest change (V/s) from one command to the next, over their distance, at least T_s.

    Of a board that samples, ten commands on as well, and over a sample more: two that it has got
    one after the other may fall into one of its samples.
    """
    more = T_s if sampled else 0.0
    pairs = itertools.chain(
        itertools.pairwise(history), zip(history, history[10:]) if sampled else ()
    )
    return max(
        (abs(v - u) / max((t - s) * 1e-9 + more, T_s) for (s, u), (t, v) in pairs), default=0.0
    )


def grain(driver: Any) -> float:
    """Step (V at the actuator) of a device's output, where it has one."""
    if not hasattr(driver, "dac_bits"):
        return 0.0
    span: float = driver.dac_max - driver.dac_min
    return abs(span / driver.calibration.amplifier[1]) / 2**driver.dac_bits


def rested(history: list[tuple[int, float]], t: int) -> float:
    """Time (ms) from t (ns) until a channel is at rest for good."""
    after = [(at, u) for at, u in history if at >= t]
    moving = [at for at, u in after if abs(u) >= REST]
    rest = [at for at, u in after if not moving or at > moving[-1]]
    return (rest[0] - t) * 1e-6 if rest else math.inf


def measure(row: Row, loop: Loop, experiment: Experiment) -> Found:
    """Inject one fault and look at what the device felt."""
    plant = experiment.each[0].nodes["plant"].params
    if "stop" in row.what:
        loop.client("stop")  # found before the voltage is high
    loop.run_in()
    t = row.act(loop)
    if row.reason in ("dead", "silent"):
        cause = loop.until(lambda: WATCHDOG.search(loop.log()), "the watchdog")[1]
        seen = min(loop.control.since(t, name)[0][0] for name in loop.device.channels)
    elif row.reason == "ended":
        loop.crew.processes["plant"].wait(PATIENCE)
        cause, seen = "ramped down, then released", t
    elif row.reason == "released":
        cause, seen = "released; a second cleanup is refused", t
    else:
        seen, cause = loop.fault()

    def rests() -> bool:
        return abs(loop.voltage()) < REST

    with contextlib.suppress(TimeoutError):
        loop.until(rests, "the safe voltage")
    time.sleep(0.3)
    histories = loop.history()
    safe = max(rested(history, t) for history in histories)
    if loop.before:
        safe = math.nan  # nobody knows what a dead device does
    peak = max((u for history in histories for _, u in history), key=abs)
    slew = max(steepest(own, experiment.T_s, sampled(loop)) for own in histories)
    limit = loop.limit or plant.safety.slew_rate
    broken = [
        text
        for text, is_so in {
            f"{peak:.3f} V outside the range": not plant.voltage_min <= peak <= plant.voltage_max,
            f"{slew:.0f} V/s above {limit:g}": slew
            > limit * 1.01 + grain(plant.driver) / experiment.T_s,
            "not at rest": not rests(),
            f"expected {row.reason}": row.reason not in ("dead", "silent", "ended")
            and not re.sub(r"^[xy]: ", "", cause).startswith(row.reason),
            "a traceback": any(
                "Traceback" in loop.log(p.stem) for p in loop.crew.log.glob("*.log")
            ),
        }.items()
        if is_so
    ]
    if row.mend is not None:
        row.mend(loop)
        loop.again()
        cause += loop.mended
    detected = max((seen - t) * 1e-6, 0.0)
    return Found(row.what, cause, detected, peak, slew, safe, "; ".join(broken))


def hasten(pid: int) -> None:
    """Let a process that is a device go before everything else, where that is permitted."""
    for thread in os.listdir(f"/proc/{pid}/task"):
        with contextlib.suppress(OSError):
            os.sched_setscheduler(int(thread), os.SCHED_FIFO, os.sched_param(20))


def sampled(loop: Loop) -> bool:
    """Whether a loop calls a compiled driver at the rate at which its board samples."""
    driver = loop.experiment.each[0].nodes["plant"].params.driver
    return isinstance(loop, OneProcess) and hasattr(driver, "pace")


def slow(name: str, folder: Path) -> str:
    """File of a rig with a compiled driver as the four nodes drive it: at the rate of `RIG`.

    Each sample of the loop asks the board for its newest.
    """
    values, own = rig.read(RIG), rig.read(name)["plant"]
    plant = {key: value for key, value in values["plant"].items() if not of_driver(key)}
    plant |= {key: value for key, value in own.items() if of_driver(key)}
    plant["driver.pace"] = "clock"
    path = folder / f"{name}.yaml"
    config.write(path, {**{node: values[node] for node in NODES}, "plant": plant})
    return str(path)


def of_driver(key: str) -> bool:
    """Whether a parameter of the plant is its driver's."""
    return key.startswith("driver.")


class Emulated:
    """The emulator of a rig, a process.

    Attributes
    ----------
    address : str
        For a driver.
    control : Control
        Of the emulator that runs.
    """

    def __init__(self, name: str, *more: str) -> None:
        self.name, self.more = name, more
        values = rig.read(name)
        self.plant, own = values["plant"], values[rig.EMULATOR]
        self.channels = own["axes"].split()[: own["stages"]] if own.get("stages", 1) > 1 else [""]
        self.address = ""
        if self.plant["driver.type"] == "registers":  # a file of its own
            self._folder = tempfile.TemporaryDirectory(dir="/dev/shm")
            self.address = f"{self._folder.name}/registers"
            self.name = f"{self._folder.name}/rig.yaml"
            text = rig.path_of(name).read_text(encoding="utf-8")
            Path(self.name).write_text(text.replace(self.plant["driver.address"], self.address))
        self.start(["--pty"] if self.serial else ["--port", "0"])

    @property
    def serial(self) -> bool:
        """Whether it is at the end of a serial line, which is another one each time."""
        return bool(self.plant["driver.address"].startswith("serial:"))

    def start(self, way: list[str]) -> None:
        """Start it at a port."""
        command = [sys.executable, "-m", "pea_cli.cli", "emulate", self.plant["driver.type"]]
        self.process = subprocess.Popen(
            [*command, "--rig", self.name, *way, *self.more],
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        assert self.process.stdout is not None
        try:
            self.address = self.process.stdout.readline().strip()
            self.control = Control(self.process.stdout.readline().strip())
        except BaseException:
            self.process.kill()
            raise
        hasten(self.process.pid)

    def again(self, number: int) -> None:
        """End it by a signal, and start another one."""
        self.end(number)
        self.start_again()

    def start_again(self) -> None:
        """Start another one at the same port, or file: it holds 0 V."""
        port = self.address.rpartition(":")[2]
        Path(self.address).unlink(missing_ok=True)
        self.start(["--port", port if port.isdecimal() else "0"])

    def close(self) -> None:
        """End it for good."""
        self.end()
        if self.plant["driver.type"] == "registers":
            self._folder.cleanup()

    def end(self, number: int = signal.SIGINT) -> None:
        """End it by a signal."""
        self.control.close()
        self.process.send_signal(number)
        assert self.process.stdout is not None
        self.process.stdout.read()
        self.process.wait(PATIENCE)
        self.process.stdout.close()


@contextlib.contextmanager
def emulator(name: str = RIG, *more: str) -> Iterator[Emulated]:
    """Start the emulator of a rig, with more options."""
    with contextlib.closing(Emulated(name, *more)) as device:
        yield device


def loaded(address: str, *more: str, name: str = RIG) -> Experiment:
    """The experiment on a rig, with more ``--set``."""
    sets = [*SETS, *LOOSER.get(name, ()), f"plant.driver.address={address}", *more]
    return experiments.load_axes(EXPERIMENT, sets, rig=name)


def attempt(
    row: Row, there: Path, experiment: Experiment, device: Emulated, kind: type[Loop] = Loop
) -> Found:
    """Start a loop and inject one fault; no cause where it did not come so far."""
    device.control.clear()
    there.mkdir(parents=True)
    loop = kind(there, experiment, device, row.spoilt)
    try:
        return measure(row, loop, experiment)
    except (AssertionError, TimeoutError, OSError) as error:
        text = " ".join(str(error).split())
        return Found(row.what, "", math.nan, math.nan, math.nan, math.nan, text)
    finally:
        loop.close()


def run(
    names: list[str], tell: Callable[[str], None], on: str = RIG, kind: type[Loop] = Loop
) -> list[Found]:
    """Inject the faults, one loop each: of four nodes, or of one process."""
    found = []
    if not names:
        return found
    slowly = kind is Loop and on in FAST
    more = SLOWLY if slowly else ()
    with emulator(on, *more) as device, tempfile.TemporaryDirectory() as folder:
        driven = slow(on, Path(folder)) if slowly else on
        for i, name in enumerate(names):
            tell(f"[{i + 1}/{len(names)}] {name} ...")
            there = Path(folder) / str(i)
            experiment = loaded(device.address, *ROWS[name].sets, name=driven)
            one = attempt(ROWS[name], there / "1", experiment, device, kind)
            if not one.cause:  # the machine stalled before anything was injected
                tell(f"    again: {one.broken}")
                one = attempt(ROWS[name], there / "2", experiment, device, kind)
            where = ", ".join(
                filter(None, (RIGS.get(on, on), "one process" * (kind is OneProcess)))
            )
            found.append(one._replace(fault=f"{where}: {one.fault}" if where else one.fault))
            tell(
                f"    {one.cause or 'no reason'}: detected {one.detected:.1f} ms, peak "
                f"{one.peak:.2f} V, {one.slew:.0f} V/s, safe {one.safe:.0f} ms"
                + (f"  BROKEN: {one.broken}" if one.broken else "")
            )
    return found


HEAD = """| fault | named reason | detected, ms | peak, V | steepest, V/s | safe, ms |
|---|---|---|---|---|---|"""


def table(found: list[Found], before: str = "") -> str:
    """The rows as Markdown, in place of those of the same fault in the table `before`."""
    rows = {line.split(" | ")[0]: line for line in before.splitlines()[2:]}
    for one in found:
        cause = re.sub(r"tcp://[\d.:]+", "device", one.cause).replace("|", "/")
        safe = "–" if math.isnan(one.safe) else f"{one.safe:.0f}"
        line = (
            f"| {one.fault} | {cause} | {one.detected:.1f} | {one.peak:.1f} | {one.slew:.0f} "
            f"| {safe} |"
        )
        rows[line.split(" | ")[0]] = line
    return "\n".join([HEAD, *rows.values()])


def main() -> int:
    """Run the command."""
    if sys.argv[1:2] == ["--as"]:
        node = sys.argv[2]
        sys.argv = [node, *sys.argv[3:]]
        stand_in(node)
        return 0
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("rows", nargs="*", metavar="ROW", help=", ".join(ROWS))
    parser.add_argument("--write", action="store_true", help="write the rows that held in the page")
    parser.add_argument("--rig", help=f"an emulated one (default: {', '.join(RIGS)})")
    parser.add_argument("--one-process", action="store_true", help="not the four nodes")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.rows if name not in ROWS]
    if unknown:
        parser.error(f"unknown row {unknown[0]!r}: one of {', '.join(ROWS)}")

    def tell(text: str) -> None:
        print(text, flush=True)

    found = []
    kinds = (OneProcess,) if arguments.one_process else (Loop, OneProcess)
    for on in [arguments.rig] if arguments.rig else RIGS:
        for kind in kinds:
            known = rows_of(on, kind)
            found += run([n for n in known if n in (arguments.rows or known)], tell, on, kind)
    print(table(found))
    broken = [one for one in found if one.broken]
    if arguments.write:  # a row that was broken stays as it was
        page = PAGE.read_text(encoding="utf-8")
        head, rest = page.split(BEGIN)
        before, tail = rest.split(END)
        part = arguments.rows or arguments.rig or arguments.one_process
        known = before.strip() if part else ""
        written = table([one for one in found if not one.broken], known)
        PAGE.write_text(f"{head}{BEGIN}\n{written}\n{END}{tail}", encoding="utf-8")
    return bool(broken)


if __name__ == "__main__":
    sys.exit(main())
