"""Every message that can be formed is used, or refused by name: topic, field, rule, in one line."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from rcl_interfaces.msg import Parameter, ParameterEvent, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import UInt8MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from pea_core import config
from pea_engine.compiled import SWITCH as COMPILE
from pea_ros.paths import FAST, SWITCH
from pea_wire import convert

FORMS = convert.forms()

FIG9 = str(config.find("experiments", "fig9_hysteresis_10hz", "experiment"))


LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def point(w: float = 0.0) -> JointTrajectoryPoint:
    return JointTrajectoryPoint(positions=[w], velocities=[0.0], accelerations=[0.0])


def big_endian(k: int) -> bytes:
    return b"\0\0\0\0" + struct.pack(">iI", 0, k)


STATE = {
    "wrong axis": (JointState(name=["y"], position=[0.0]), "name: 'y': must hold the axis 'x'"),
    "no name": (JointState(position=[0.0]), "name: nothing: must hold the axis 'x'"),
    "two numbers": (JointState(name=["x"], position=[0.0, 1.0]), "position: 2 numbers"),
    "no velocity": (JointState(name=["x"], position=[0.0], effort=[0.0]), "velocity: nan"),
    "infinite": (
        JointState(name=["x"], position=[0.0], velocity=[np.inf], effort=[0.0]),
        "velocity: inf: must be one finite number",
    ),
    "truncated": (
        FORMS.state.encode(0, 1.0, 2.0, 3.0)[:-8],
        "effort: message ends early",
    ),
    "big endian, truncated": (big_endian(0), "header: message ends early"),
    "other encapsulation": (b"\0\7\0\0" + bytes(60), "encapsulation: 00070000"),
    "empty": (b"", "encapsulation: nothing"),
    "huge text": (
        convert.ENCAPSULATION + struct.pack("<iII", 0, 0, 2**32 - 1) + b"x" * 50,
        "header: message ends early",
    ),
    "no text": (
        FORMS.state.encode(0, 1.0, 2.0, 3.0).replace(b"x\0", b"\xff\0"),
        "name: a text of 2 bytes is no UTF-8",
    ),
    "far stamp": (FORMS.state.encode(10**18, 1.0, 2.0, 3.0), "expected sample 0"),
    "negative stamp": (FORMS.state.encode(-5, 1.0, 2.0, 3.0), "expected sample 0"),
}
REFERENCE = {
    "empty trajectory": (JointTrajectory(joint_names=["x"]), "points: none: must be one at least"),
    "wrong joint": (JointTrajectory(joint_names=["a\nb"], points=[point()]), r"'a\nb': must hold"),
    "no velocity": (
        JointTrajectory(joint_names=["x"], points=[JointTrajectoryPoint(positions=[1.0])]),
        "points[0]: must hold position, velocity and acceleration",
    ),
    "nan": (
        JointTrajectory(joint_names=["x"], points=[point(), point(np.nan)]),
        "points[1]: [nan, 0.0, 0.0]: must be finite",
    ),
    "all at once": (
        JointTrajectory(joint_names=["x"], points=[point(), point()]),
        "expected points from sample 0 on",
    ),
    "very many": (
        FORMS.reference.encode(0, 50_000, np.zeros((20_000, 3))),
        "points: 20000 of them: must be at most 16384",
    ),
}
CONSUMED = {
    "negative": (Time(sec=-1), "time: -1000000000 ns: must be that of a sample"),
    "truncated": (convert.encode_time(0)[:-4], "time: message ends early"),
}


def raw(message: Any) -> bytes:
    return message if isinstance(message, bytes) else serialize_message(message)


class Around(Node):
    """Stands in for the neighbours of one node: publishes, subscribes and says nothing."""

    def __init__(self, ros: Any, publish: dict[str, type], subscribe: dict[str, type]) -> None:
        super().__init__("around", context=ros.context)
        self.of = {
            topic: self.create_publisher(kind, f"/pea/{topic}", LATCHED if kind is Time else 10)
            for topic, kind in publish.items()
        }
        for topic, kind in subscribe.items():
            self.create_subscription(kind, f"/pea/{topic}", lambda message: None, 10)
        ros.executor.add_node(self)


AROUND = {
    "controller": (
        {"displacement": JointState, "state": JointState, "reference": JointTrajectory},
        {"voltage": JointState, "consumed": Time},
    ),
    "reference": ({"voltage": JointState, "consumed": Time}, {"reference": JointTrajectory}),
}


def refused(ros: Any, node: str, topic: str, messages: list[Any], words: str) -> None:
    around = Around(ros, *AROUND[node])
    ros.start(node, "--ros-args", "--params-file", FIG9)
    ros.says(node, "all neighbours are there")
    for message in messages:
        around.of[topic].publish(raw(message))
    assert ros.until(lambda: ros.processes[node].poll() is not None), ros.log(node)
    assert ros.processes[node].returncode == 3, ros.log(node)
    (line,) = [s for s in ros.log(node).splitlines() if not s.startswith("[")]
    assert line.startswith(f"{node}: /pea/{topic}: "), line
    assert words in line
    around.destroy_node()


@pytest.mark.parametrize("case", ["wrong axis", "truncated"])
def test_a_state_that_cannot_be_used_ends_the_controller_in_one_line(ros, case):
    message, words = STATE[case]
    around = Around(ros, *AROUND["controller"])
    chunk = FORMS.reference.encode(0, 50_000, np.zeros((1000, 3)))
    ros.start("controller", "--ros-args", "--params-file", FIG9)
    assert ros.until(lambda: around.of["reference"].get_subscription_count())
    around.of["reference"].publish(chunk)
    around.of["state"].publish(raw(message))
    assert ros.until(lambda: ros.processes["controller"].poll() is not None), ros.log("controller")
    assert ros.processes["controller"].returncode == 3
    (line,) = [s for s in ros.log("controller").splitlines() if not s.startswith("[")]
    assert line.startswith("controller: /pea/state: ")
    assert words in line
    around.destroy_node()


@pytest.mark.parametrize(("message", "words"), STATE.values(), ids=STATE)
def test_each_state_is_refused_by_field_and_rule(message, words):
    if "sample" in words:
        assert FORMS.state.receive(raw(message)).stamp != 0  # the node refuses the stamp
        return
    with pytest.raises(convert.ConversionError) as refusal:
        FORMS.state.receive(raw(message))
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(("message", "words"), REFERENCE.values(), ids=REFERENCE)
def test_each_chunk_is_refused_by_field_and_rule(message, words):
    if "sample" in words:
        assert len(FORMS.reference.receive(raw(message))[1]) == 2  # the node compares the times
        return
    with pytest.raises(convert.ConversionError) as refusal:
        FORMS.reference.receive(raw(message))
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("case", ["empty trajectory", "all at once"])
def test_a_chunk_that_cannot_be_used_ends_the_controller_in_one_line(ros, case):
    message, words = REFERENCE[case]
    around = Around(ros, *AROUND["controller"])
    ros.start("controller", "--ros-args", "--params-file", FIG9)
    ros.says("controller", "all neighbours are there")
    around.of["reference"].publish(raw(message))
    assert ros.until(lambda: ros.processes["controller"].poll() is not None), ros.log("controller")
    assert ros.processes["controller"].returncode == 3
    (line,) = [s for s in ros.log("controller").splitlines() if not s.startswith("[")]
    assert line.startswith("controller: /pea/reference: ")
    assert words in line
    around.destroy_node()


@pytest.mark.parametrize(("message", "words"), CONSUMED.values(), ids=CONSUMED)
def test_a_stamp_that_cannot_be_ends_the_reference_in_one_line(ros, message, words):
    refused(ros, "reference", "consumed", [message], words)


def test_what_was_not_sent_cannot_be_used(ros):
    around, heard = Around(ros, *AROUND["reference"]), []
    around.create_subscription(JointTrajectory, "/pea/reference", heard.append, 10)
    ros.start("reference", "--ros-args", "--params-file", FIG9)
    ros.says("reference", "all neighbours are there")
    around.of["consumed"].publish(Time())
    assert ros.until(lambda: len(heard) == 3), ros.log("reference")
    around.of["consumed"].publish(Time(sec=100))
    assert ros.until(lambda: ros.processes["reference"].poll() is not None)
    assert ros.processes["reference"].returncode == 3
    (line,) = [s for s in ros.log("reference").splitlines() if not s.startswith("[")]
    assert line.startswith("reference: /pea/consumed: time: 100000000000 ns: must be")
    assert "from 0 to 150000000 ns" in line
    around.destroy_node()


BLOCKS = {
    "rows of one byte": convert.encode_block(1, bytes(40)),
    "no rows": UInt8MultiArray(),
    "other sizes": UInt8MultiArray(data=b"abc"),
    "zeros": convert.encode_block(50, b"\1" * 100),
}


@pytest.mark.parametrize("message", BLOCKS.values(), ids=BLOCKS)
def test_a_block_that_is_none_is_refused(message):
    with pytest.raises(convert.ConversionError, match="data: "):
        convert.decode_block(raw(message))


def test_foreign_events_and_blocks_end_the_recorder_well(ros, tmp_path):
    names = ("displacement", "state", "voltage")
    around = Around(
        ros,
        {
            **dict.fromkeys(names, JointState),
            **{f"{name}/blocks": UInt8MultiArray for name in names},
            "reference": JointTrajectory,
        },
        {"recorded": Time},
    )
    events = around.create_publisher(ParameterEvent, "/parameter_events", 10)
    ros.start("recorder", "--ros-args", "-p", f"out:={tmp_path}/bag")
    ros.says("recorder", "all neighbours are there")
    strange = ParameterEvent(node="/pea/controller")
    strange.stamp.sec = -5
    kind = ParameterEvent(node="/pea/controller")
    kind.changed_parameters = [Parameter(name="P", value=ParameterValue(type=77))]
    for event in (strange, kind, b"\0\1\0\0\1"):
        events.publish(raw(event))
    ros.says("recorder", "not recorded: /parameter_events: parameters: one is of type 77")
    assert ros.processes["recorder"].poll() is None
    around.of["state/blocks"].publish(raw(BLOCKS["rows of one byte"]))
    assert ros.until(lambda: ros.processes["recorder"].poll() is not None)
    assert ros.processes["recorder"].returncode == 3
    (line,) = [s for s in ros.log("recorder").splitlines() if not s.startswith("[")]
    assert line.startswith("recorder: /pea/state/blocks: data: 40 bytes")
    assert (tmp_path / "bag" / "metadata.yaml").exists()
    around.destroy_node()


def test_a_request_that_rclpy_does_not_understand_ends_no_node(ros):
    ros.env |= {SWITCH: FAST, COMPILE: "0"}
    ros.start("controller", "--ros-args", "--params-file", FIG9)
    client = ros.node.create_client(SetParameters, "/pea/controller/set_parameters")
    assert ros.until(client.service_is_ready)
    odd = Parameter(name="P", value=ParameterValue(type=77))
    client.call_async(SetParameters.Request(parameters=[odd]))
    ros.says("controller", "a request of another node is not served: ValueError: 77")
    fine = Parameter(name="P", value=ParameterValue(type=3, double_value=0.001))
    asked = client.call_async(SetParameters.Request(parameters=[fine]))
    assert ros.until(asked.done)
    assert asked.result().results[0].successful
    assert ros.end("controller") == 0
