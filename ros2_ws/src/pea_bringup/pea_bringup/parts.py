"""What the launch files have in common: where files lie, how nodes find each other and start."""

import os
import sys
from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import (
    EnvironmentVariable,
    LaunchConfiguration,
    NotEqualsSubstitution,
    PathJoinSubstitution,
)
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from pea_core.config import (
    NAMESPACE,
    SECTIONS,
    absolute,
    check_sections,
    read,
    resolve_axes,
    spaced,
)
from pea_core.parameter_file import sections
from pea_core.params import ParameterError, nearest
from pea_plant import drivers
from pea_plant.plant import Params

CONFIG = (FindPackageShare("pea_bringup"), "config")

RIGS = "rigs"

BAG = DeclareLaunchArgument(
    "bag", default_value="", description="new directory of the recording; empty: none"
)

SPACE = DeclareLaunchArgument(
    "namespace",
    default_value="",
    description="namespace of the nodes; empty: that of an including launch file, else /pea",
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


def namespace(context):
    """Namespace of the nodes: the argument's, in or instead of the one that was pushed."""
    asked = context.launch_configurations.get("namespace", "")
    pushed = context.launch_configurations.get("ros_namespace", "")
    if asked:
        spaced(asked, "namespace")
    if asked.startswith("/") or not pushed:
        return "/" + asked.strip("/") if asked else NAMESPACE
    return "/" + "/".join(part for part in (pushed.strip("/"), asked.strip("/")) if part)


def refuse_unknown(context, path, known):
    """Refuse an argument that the launch file does not have, where it was started by its name.

    Included by another one, it cannot tell whose an argument is.

    Raises
    ------
    ParameterError
        One line that names the nearest valid choice.
    """
    if any(Path(word).name == Path(path).name for word in sys.argv):
        for name in (word.partition(":=")[0] for word in context.argv):
            if name not in known:
                raise ParameterError(f"unknown argument {name}:= {nearest(name, known)}")


def refuse_bag(place):
    """Refuse a directory that no recording can be begun in.

    Raises
    ------
    ParameterError
        One line that names it.
    """
    try:
        Path(place).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ParameterError(f"bag {place!r}: {error.strerror}") from None
    if next(Path(place).glob("*.mcap"), None) or (Path(place) / "metadata.yaml").exists():
        raise ParameterError(f"bag {place!r}: has a recording; name a new directory")


def refuse(space, folder, name, value):
    """Refuse a file that is not there, or says nothing of the nodes, before a node starts.

    Raises
    ------
    ParameterError
        One line that names the nearest valid choice.
    """
    place = Path(get_package_share_directory("pea_bringup")) / "config" / folder
    path = place / value
    if not path.is_file():
        if os.path.isabs(value):
            raise ParameterError(f"{name} {value!r}: no such file")
        known = [each.stem for each in place.glob("*.yaml") if each.exists()]
        word = value.removesuffix(".yaml")
        raise ParameterError(f"unknown {name} {word!r}: {nearest(word, known)}")
    check_sections(path, sections(path), SECTIONS, space)
    if folder == RIGS:
        refuse_driver(path, space)


def refuse_driver(path, space):
    """Refuse a rig whose driver cannot be made, before a node starts; nothing is opened.

    Raises
    ------
    ParameterError
        A parameter of its plant is wrong, or a Python package that the driver needs is missing.
    """
    values = absolute(read(path, SECTIONS, space)["plant"], path.parent)
    each = resolve_axes("plant", Params, [values])
    drivers.check(tuple(one.params for one in each), each[0].node.T_s)


def checked(make, path, arguments, **files):
    """Check every argument, then make the actions for the namespace.

    Parameters
    ----------
    make : callable
        Gets the namespace; gives actions.
    path : str
        The launch file.
    arguments : sequence of DeclareLaunchArgument
        Those of the launch file.
    **files : tuple
        Argument to folder and what its files are.
    """

    def act(context):
        refuse_unknown(context, path, [argument.name for argument in arguments])
        space = namespace(context)
        for argument, (folder, name) in files.items():
            refuse(space, folder, name, context.launch_configurations[argument])
        if files and context.launch_configurations["bag"]:
            refuse_bag(context.launch_configurations["bag"])
        return make(space)

    return OpaqueFunction(function=act)


def discovery():
    """Nodes stay on this machine where the user asks for nothing else; the profile is theirs."""
    name = "ROS_AUTOMATIC_DISCOVERY_RANGE"
    return [SetEnvironmentVariable(name, EnvironmentVariable(name, default_value="LOCALHOST"))]


def recorder(space, params):
    """The recorder, where there is a bag to write."""
    return Node(
        package="pea_run",
        executable="recorder",
        namespace=space,
        output="screen",
        parameters=[params, {"out": ParameterValue(LaunchConfiguration("bag"), value_type=str)}],
        condition=IfCondition(given("bag")),
    )


def block(space, role, *files, kind=Node, **options):
    """The node of a block; where there is a bag, it does not start without the recorder."""
    return kind(
        package=f"pea_{role}",
        executable=role,
        namespace=space,
        output="screen",
        parameters=[*files, {"wait_for_recorder": given("bag")}],
        **options,
    )
