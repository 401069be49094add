"""The graph of a run is the one table: topics, types, QoS; docs/topics.md lists the same."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from builtin_interfaces.msg import Time
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from pea_core import config
from pea_wire import topics
from pea_wire.topics import BESIDE, DIAGNOSTICS, OWNED, PARAMETER_EVENTS

DOCS = Path(__file__).parents[1] / "docs/topics.md"
RIG = ("--ros-args", "--params-file", str(config.find("rigs", "simulated_200hz", "rig")))
TRANSITIONS = "/pea/plant/transition_event"
TABLE = {topic.name: topic for topic in (*OWNED, DIAGNOSTICS)}
ASKS = {
    "best effort": ({"reliability": ReliabilityPolicy.BEST_EFFORT}, True),
    "reliable, one": ({}, True),
    "transient local": ({"durability": DurabilityPolicy.TRANSIENT_LOCAL}, False),
    "a deadline": ({"deadline": Duration(seconds=1.0)}, False),
    "manual liveliness": ({"liveliness": LivelinessPolicy.MANUAL_BY_TOPIC}, False),
}


def test_the_docs_list_the_table():
    rows = [line for line in DOCS.read_text().splitlines() if line.startswith("| `/")]
    listed = {name: row for row in rows for name in re.findall(r"`(/\S+)`", row.split("|")[1])}
    table = TABLE | {topic.name: topic for topic in topics.TABLE if topic != PARAMETER_EVENTS}
    assert set(listed) == {*table, TRANSITIONS}
    for name, topic in table.items():
        kind = topic.type.replace("/msg/", "/")
        assert f"`{kind}`" in listed[name]
        assert re.search(rf"\| {topic.depth}\b", listed[name]), listed[name]


def test_the_graph_of_a_run_is_the_table(ros: Any, tmp_path: Path):
    ros.start("recorder", "--ros-args", "-p", f"out:={tmp_path}/bag", "-p", "T_s:=5e-3")
    for node in ("plant", "observer", "controller", "reference"):
        ros.start(node, *RIG, *(("-p", "clock:=wall") if node == "plant" else ()))
    ros.says("plant", "loop starts")
    subscribers = {
        name: ros.node.create_subscription(
            JointState, "/pea/state", lambda message: None, QoSProfile(depth=1, **asks)
        )
        for name, (asks, _) in ASKS.items()
    }
    ros.node.create_subscription(Time, "/pea/consumed", lambda message: None, 1)

    def matched() -> dict[str, bool]:
        return {name: s.handle.get_publisher_count() > 0 for name, s in subscribers.items()}

    assert ros.until(lambda: matched()["reliable, one"])
    assert matched() == {name: fits for name, (_, fits) in ASKS.items()}

    def found() -> dict[str, list[str]]:
        names = dict(ros.node.get_topic_names_and_types(no_demangle=False))
        return {name: kinds for name, kinds in names.items() if name.startswith("/pea/")}

    owned = {name: [topic.type] for name, topic in TABLE.items() if topic.publisher}
    # the recorder asks for those that it may record, whether a node has them or not
    owned |= {topic.name: [topic.type] for topic in BESIDE if topic.publisher}
    assert found() == {**owned, TRANSITIONS: ["lifecycle_msgs/msg/TransitionEvent"]}
    for name, topic in TABLE.items():
        ends = ros.node.get_publishers_info_by_topic(name)
        assert {end.topic_type for end in ends} == {topic.type}
        if topic.publisher:
            (end,) = ends
            assert f"{end.node_namespace}/{end.node_name}" == f"/pea/{topic.publisher}"
        for end in ends:
            offered = end.qos_profile
            assert offered.reliability == ReliabilityPolicy.RELIABLE
            latched = offered.durability == DurabilityPolicy.TRANSIENT_LOCAL
            assert latched == topic.latched
    assert PARAMETER_EVENTS.name not in TABLE
    assert not re.search("_probe", str(ros.node.get_topic_names_and_types()))
