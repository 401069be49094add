"""The four nodes on a rig in wall time: plant, observer and controller as the rig's file says.

ros2 launch pea_bringup rig.launch.py rig:=e727_emulated experiment:=fig9_hysteresis_10hz

Of the experiment comes the reference alone. The plant's node is a lifecycle node, /pea/plant: it
configures and activates itself when its neighbours are there, and `ros2 lifecycle set /pea/plant
deactivate` brings the voltage to rest. Nothing is computed here: nodes and files are picked.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import (
    EnvironmentVariable,
    LaunchConfiguration,
    NotEqualsSubstitution,
    PathJoinSubstitution,
)
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

CONFIG = (FindPackageShare("pea_bringup"), "config")

ARGUMENTS = (
    DeclareLaunchArgument(
        "rig",
        default_value="simulated_200hz",
        description="name of a file in config/rigs/, without .yaml",
    ),
    DeclareLaunchArgument(
        "experiment",
        default_value="fig9_hysteresis_10hz",
        description="whose reference is followed: a file in config/experiments/, without .yaml",
    ),
    DeclareLaunchArgument(
        "rig_params",
        default_value=[LaunchConfiguration("rig"), ".yaml"],
        description="the rig's file itself; a path that is absolute may lie anywhere",
    ),
    DeclareLaunchArgument(
        "params",
        default_value=[LaunchConfiguration("experiment"), ".yaml"],
        description="the experiment's file itself; likewise",
    ),
    DeclareLaunchArgument(
        "bag", default_value="", description="new directory of the recording; empty: none"
    ),
)


def generate_launch_description():
    # a path that is joined to an absolute one is the absolute one
    rig, experiment = (
        PathJoinSubstitution([*CONFIG, folder, LaunchConfiguration(name)])
        for folder, name in (("rigs", "rig_params"), ("experiments", "params"))
    )
    profile = PathJoinSubstitution([*CONFIG, "fastdds.xml"])
    environment = [
        SetEnvironmentVariable(name, EnvironmentVariable(name, default_value=value))
        for name, value in (
            ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"),
            ("FASTRTPS_DEFAULT_PROFILES_FILE", profile),
        )
    ]
    recorder = Node(
        package="pea_runtime",
        executable="recorder",
        output="screen",
        parameters=[rig, {"out": LaunchConfiguration("bag")}],
        condition=IfCondition(NotEqualsSubstitution(LaunchConfiguration("bag"), "")),
    )
    blocks = [
        Node(package=f"pea_{block}", executable=block, output="screen", parameters=files)
        for block, files in (
            ("plant", [rig]),
            ("observer", [rig]),
            ("controller", [rig]),
            ("reference", [experiment, rig]),
        )
    ]
    return LaunchDescription([*ARGUMENTS, *environment, recorder, *blocks])
