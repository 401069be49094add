"""The node of a shell as others see it."""

import time

from domain_coordinator import domain_id
from rcl_interfaces.msg import ParameterEvent
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from pea_ros.context import context
from pea_ros.shell import Given

PATIENCE = 30.0


def test_what_a_node_declares_before_the_loop_is_stamped_zero(monkeypatch):
    """Who listens already hears of what files and the command line say while the node is made."""
    heard = {}

    def hear(event):
        stamp = event.stamp.sec * 10**9 + event.stamp.nanosec
        heard.update({each.name: stamp for each in event.new_parameters})

    with domain_id() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        with context():
            listener = Node("listener")
            listener.create_subscription(ParameterEvent, "/parameter_events", hear, 100)
            executor = SingleThreadedExecutor()
            executor.add_node(listener)
            given = Given(
                "observer",
                namespace="/pea",
                parameter_overrides=[Parameter("omega_o", value=2e4), Parameter("notch", value=[])],
                automatically_declare_parameters_from_overrides=True,
            )
            asked = {"omega_o", "use_sim_time", "start_type_description_service"}
            end = time.monotonic() + PATIENCE
            while not heard.keys() >= asked and time.monotonic() < end:
                executor.spin_once(0.1)
            given.destroy_node()
            listener.destroy_node()
    assert {name: heard.get(name) for name in asked} == dict.fromkeys(asked, 0)
