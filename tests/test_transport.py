"""Three ways over DDS, one result; what is lost on the way is found again."""

from __future__ import annotations

from typing import Any

import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from sensor_msgs.msg import JointState

from pea_engine.compiled import SWITCH as COMPILE
from pea_ros import path_choice, turbo
from pea_ros.paths import FAST, NAIVE, SWITCH, TURBO
from pea_ros.transport import Inbox, SampledOutbox
from pea_wire import convert
from pea_wire.topics import DISPLACEMENT, STATE, VOLTAGE

FORMS = convert.forms()

T_NS = 50_000
SHORT = ("fig9_hysteresis_10hz", "--duration", "0.0157")
NOISY = (
    *SHORT,
    *("--seed", "5"),
    *("--set", "plant.hysteresis.type=prandtl_ishlinskii"),
    *("--set", "plant.sensor.noise_nm=0.7"),
    *("--set", "plant.delay_samples=1"),
    *("--set", "observer.type=extended_state"),
    *("--set", "controller.preset=recommended"),
)


WAYS = [(NAIVE, "0", NOISY), (FAST, "0", NOISY), (FAST, "1", SHORT), (TURBO, "1", SHORT)]
"""Each way, whether the blocks are compiled, and what runs."""


@pytest.mark.parametrize(("way", "compiled", "setting"), WAYS)
def test_every_way_gives_the_same_bits(
    start_pea, user_environment, recorded, setting, way, compiled
):
    running = start_pea(
        *("run", *setting, "--mode", "distributed", "--out", "run", "--json"),
        env=user_environment(**{SWITCH: way, COMPILE: compiled}),
    )
    done = running.finish(110.0)
    assert done.status == 0, done.err
    assert done.metrics["lost_samples"] == 0
    assert done.metrics["trace_sha256"] == recorded("batch", *setting).metrics["trace_sha256"]
    for node in ("plant", "observer", "controller"):
        log = (running.there / "run" / "log" / f"{node}.log").read_text()
        assert f"transport: {way} ({SWITCH} asks for it)" in log
        assert ("compiled from sample 0 on" in log) == (compiled == "1")


def test_unknown_way_is_refused(start_pea, user_environment):
    running = start_pea(
        "run", *SHORT, "--mode", "distributed", env=user_environment(**{SWITCH: "trubo"})
    )
    done = running.finish()
    assert done.status == 2
    assert "PEA_TRANSPORT = 'trubo'" in done.err.splitlines()[-1]
    assert "did you mean turbo?" in done.err.splitlines()[-1]


class Forgetful(Node):
    """A law, u = 2 V, of which a message goes missing on the way, but not its block."""

    def __init__(self, context: Context, lost: int) -> None:
        super().__init__("forgetful", context=context, namespace="pea")
        self.lost = lost
        self.late = b""
        self.outbox = SampledOutbox(self, VOLTAGE, FAST, FORMS.voltage.size)
        self.create_subscription(JointState, STATE.name, self.estimated, 10)
        self.last = -1

    def estimated(self, state: JointState) -> None:
        stamp = state.header.stamp.sec * 10**9 + state.header.stamp.nanosec
        self.last = stamp // T_NS
        data = FORMS.voltage.encode(stamp, 2.0)
        if self.last == self.lost:
            self.outbox.sent(data)
            self.outbox.flush()
            self.late = data
        else:
            self.outbox.send(data)
            self.outbox.flush()
        if self.late and self.last == self.lost + 10:
            self.outbox.send(self.late)  # late after all
            self.late = b""


@pytest.mark.parametrize(("way", "compiled"), [(FAST, "0"), (TURBO, "1")])
def test_missing_message_is_found_in_its_block(ros, way, compiled):
    law = Forgetful(ros.context, lost=50)
    ros.executor.add_node(law)
    ros.env |= {SWITCH: way, COMPILE: compiled}
    for node in ("plant", "observer"):
        ros.start(node)
    assert ros.until(lambda: law.last > 100, 100.0), ros.log("plant")
    assert not law.late
    assert ros.processes["plant"].poll() is None
    law.destroy_node()


class Twice(Node):
    """A law that sends one of its commands twice."""

    def __init__(self, context: Context) -> None:
        super().__init__("twice", context=context)
        self.voltage = self.create_publisher(JointState, VOLTAGE.name, 10)
        self.create_subscription(JointState, STATE.name, self.estimated, 10)

    def estimated(self, state: JointState) -> None:
        command = JointState(name=list(state.name), effort=[2.0])
        command.header.stamp = state.header.stamp
        self.voltage.publish(command)
        if state.header.stamp.nanosec == 50 * T_NS:
            self.voltage.publish(command)


@pytest.mark.parametrize(("way", "compiled"), [(NAIVE, "0"), (TURBO, "1")])
def test_command_sent_twice_stops_the_plant_and_is_named(ros, way, compiled):
    law = Twice(ros.context)
    ros.executor.add_node(law)
    ros.env |= {SWITCH: way, COMPILE: compiled}
    for node in ("plant", "observer"):
        ros.start(node)
    assert ros.until(lambda: ros.processes["plant"].poll() is not None, 100.0), ros.log("plant")
    assert ros.processes["plant"].returncode == 3
    (line,) = [s for s in ros.log("plant").splitlines() if s.startswith("plant: ")]
    assert "expected sample 51" in line
    assert "got 50" in line
    law.destroy_node()


@pytest.fixture
def node(free_domain: int, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    context = Context()
    rclpy.init(context=context, domain_id=free_domain)
    node = Node("somebody", context=context)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


@pytest.mark.parametrize("exchange", [path_choice.by_hand, turbo.by_librcl])
def test_probe_comes_back_whole(node, exchange):
    path_choice.probe(node, exchange)


def test_probe_notices_a_changed_message(node):
    def spoiled(outbox: Any, inbox: Any, data: bytes) -> bytes:
        return path_choice.by_hand(outbox, inbox, data)[:-1] + b"\1"

    with pytest.raises(OSError, match=r"sent .*, got "):
        path_choice.probe(node, spoiled)


@pytest.mark.parametrize(
    ("wish", "samples", "way"),
    [
        (None, 10**9, TURBO),
        (None, 100, FAST),
        (NAIVE, 10**9, NAIVE),
        (FAST, 10**9, FAST),
        (TURBO, 100, TURBO),
    ],
)
def test_choice_of_the_way(node, monkeypatch, wish, samples, way):
    monkeypatch.delenv("PEA_COMPILE", raising=False)
    monkeypatch.delenv(SWITCH, raising=False)
    if wish:
        monkeypatch.setenv(SWITCH, wish)
    assert path_choice.path_for(node, samples)[0] == way


def test_nothing_compiled_where_the_user_forbids_it(node, monkeypatch):
    monkeypatch.setenv("PEA_COMPILE", "0")
    monkeypatch.setenv(SWITCH, TURBO)
    path, why = path_choice.path_for(node, 10**9)
    assert path == FAST
    assert "PEA_COMPILE=0" in why


def broken(*arguments: Any) -> bytes:
    raise AttributeError("no such function in this release")


def test_another_librcl_falls_back_to_fast(node, monkeypatch):
    monkeypatch.setattr(turbo, "by_librcl", broken)
    path, why = path_choice.path_for(node, 10**9)
    assert path == FAST
    assert "turbo fails its probe: AttributeError: no such function" in why


def test_another_rclpy_falls_back_to_naive(node, monkeypatch):
    monkeypatch.setattr(path_choice, "by_hand", broken)
    path, why = path_choice.path_for(node, 10**9)
    assert path == NAIVE
    assert "fast fails its probe" in why


def test_block_holds_what_was_sent(node):
    outbox = SampledOutbox(node, DISPLACEMENT, FAST, FORMS.displacement.size)
    inbox = Inbox(node, DISPLACEMENT, best_effort=True)
    sent = [FORMS.displacement.encode(k * T_NS, float(k), -float(k)) for k in range(5)]
    outbox.send(sent[0])
    outbox.sent(b"".join(sent[1:]))
    outbox.flush()
    inbox.wait(2.0)
    assert inbox.take() == sent[0]
    inbox.blocks.wait(2.0)
    inbox.keep()
    assert [inbox.missed(k * T_NS) for k in range(6)] == [*sent, None]
