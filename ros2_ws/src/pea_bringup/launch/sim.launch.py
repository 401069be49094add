"""The four nodes with the simulated actuator, from one experiment file, and the recorder.

ros2 launch pea_bringup sim.launch.py experiment:=fig9_hysteresis_10hz bag:=$PWD/runs/mine

Nothing is computed here: nodes and files are picked. The nodes come in any order, wait for each
other, and start the loop by themselves.
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
        "experiment",
        default_value="fig9_hysteresis_10hz",
        description="name of a file in config/experiments/, without .yaml",
    ),
    DeclareLaunchArgument(
        "params",
        default_value=[LaunchConfiguration("experiment"), ".yaml"],
        description="the file itself; a path that is absolute may lie anywhere, as params.yaml of "
        "a run",
    ),
    DeclareLaunchArgument(
        "bag", default_value="", description="new directory of the recording; empty: none"
    ),
    DeclareLaunchArgument(
        "transport", default_value="", description="naive, fast or turbo; empty: the best there is"
    ),
)


def generate_launch_description():
    # a path that is joined to an absolute one is the absolute one
    params = PathJoinSubstitution([*CONFIG, "experiments", LaunchConfiguration("params")])
    profile = PathJoinSubstitution([*CONFIG, "fastdds.xml"])
    environment = [
        SetEnvironmentVariable(name, EnvironmentVariable(name, default_value=value))
        for name, value in (
            ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"),
            ("FASTRTPS_DEFAULT_PROFILES_FILE", profile),
        )
    ]
    path = SetEnvironmentVariable(
        "PEA_TRANSPORT",
        LaunchConfiguration("transport"),
        condition=IfCondition(NotEqualsSubstitution(LaunchConfiguration("transport"), "")),
    )
    recorded = IfCondition(NotEqualsSubstitution(LaunchConfiguration("bag"), ""))
    recorder = Node(
        package="pea_runtime",
        executable="recorder",
        output="screen",
        parameters=[params, {"out": LaunchConfiguration("bag")}],
        condition=recorded,
    )
    blocks = [
        Node(package=f"pea_{block}", executable=block, output="screen", parameters=[params])
        for block in ("plant", "observer", "controller", "reference")
    ]
    return LaunchDescription([*ARGUMENTS, *environment, path, recorder, *blocks])
