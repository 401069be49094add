"""The four nodes and the recorder, from one experiment file.

ros2 launch pea_bringup pea.launch.py experiment:=fig9_hysteresis_10hz bag:=/tmp/run
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import LaunchConfigurationNotEquals
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    experiment = PathJoinSubstitution(
        [
            FindPackageShare("pea_bringup"),
            "config",
            "experiments",
            [LaunchConfiguration("experiment"), ".yaml"],
        ]
    )
    blocks = [
        Node(
            package=f"pea_{block}",
            executable=block,
            output="screen",
            parameters=[experiment],
        )
        for block in ("plant", "observer", "controller", "reference")
    ]
    recorder = Node(
        package="pea_runtime",
        executable="recorder",
        output="screen",
        parameters=[{"out": LaunchConfiguration("bag")}],
        condition=LaunchConfigurationNotEquals("bag", ""),
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument("experiment", default_value="fig9_hysteresis_10hz"),
            DeclareLaunchArgument("bag", default_value=""),
            *blocks,
            recorder,
        ]
    )
