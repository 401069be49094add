"""A process of ours starts where the middleware can write no log file."""

import pytest
from rclpy.node import Node

from pea_ros.context import UNLOGGED, context, loggable


@pytest.mark.parametrize("name", ["HOME", "ROS_HOME", "ROS_LOG_DIR"])
def test_a_folder_that_cannot_be_written_is_no_hindrance(monkeypatch, name):
    for other in ("ROS_HOME", "ROS_LOG_DIR"):
        monkeypatch.delenv(other, raising=False)
    monkeypatch.setenv(name, "/dev/null/none")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    assert loggable(["one"]) == ["one", *UNLOGGED]
    with context():
        Node("somebody").destroy_node()


def test_where_it_can_be_written_it_is(monkeypatch, tmp_path):
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "log"))
    assert loggable(["one"]) == ["one"]
