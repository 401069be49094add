"""What the launch files have in common: where files lie, how nodes find each other and start."""

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

BAG = DeclareLaunchArgument(
    "bag", default_value="", description="new directory of the recording; empty: none"
)


def named(argument, default, description):
    """Argument for the name of a file."""
    return DeclareLaunchArgument(argument, default_value=default, description=description)


def path_of(argument, name, description):
    """Argument for the file itself, which by default is the one of the argument `name`."""
    default = [LaunchConfiguration(name), ".yaml"]
    return DeclareLaunchArgument(argument, default_value=default, description=description)


def file(folder, argument):
    """The file that an argument names: in a folder of config/, or where an absolute path leads."""
    return PathJoinSubstitution([*CONFIG, folder, LaunchConfiguration(argument)])


def given(argument):
    """Whether an argument is not empty."""
    return NotEqualsSubstitution(LaunchConfiguration(argument), "")


def discovery():
    """Nodes find each other at once, on this machine, where the user asks for nothing else."""
    profile = PathJoinSubstitution([*CONFIG, "fastdds.xml"])
    return [
        SetEnvironmentVariable(name, EnvironmentVariable(name, default_value=value))
        for name, value in (
            ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"),
            ("FASTRTPS_DEFAULT_PROFILES_FILE", profile),
        )
    ]


def recorder(params):
    """The recorder, where there is a bag to write."""
    return Node(
        package="pea_runtime",
        executable="recorder",
        output="screen",
        parameters=[params, {"out": LaunchConfiguration("bag")}],
        condition=IfCondition(given("bag")),
    )


def block(role, *files, kind=Node, **options):
    """The node of a block; where there is a bag, it does not start without the recorder."""
    return kind(
        package=f"pea_{role}",
        executable=role,
        output="screen",
        parameters=[*files, {"wait_for_recorder": given("bag")}],
        **options,
    )
