"""A recording on the ROS graph, for RViz, PlotJuggler, rqt_plot or `ros2 topic echo`.

ros2 launch pea_bringup replay.launch.py bag:=$PWD/runs/latest

Nothing is computed here: `pea replay --publish` is started. /pea/voltage, which moves a stage, is
not played.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackagePrefix

from pea_bringup.parts import SPACE, checked

ARGUMENTS = (
    DeclareLaunchArgument("bag", description="directory of the recording"),
    DeclareLaunchArgument("rate", default_value="1.0", description="speed; 1: as recorded"),
    DeclareLaunchArgument("start", default_value="0.0", description="seconds to leave out"),
    SPACE,
)


def player(space):
    pea = PathJoinSubstitution([FindPackagePrefix("pea_cli"), "lib", "pea_cli", "pea"])
    options = [
        part for name in ("rate", "start") for part in (f"--{name}", LaunchConfiguration(name))
    ]
    words = ["replay", LaunchConfiguration("bag"), "--publish", *options, "--namespace", space]
    return [ExecuteProcess(cmd=[pea, *words], output="screen")]


def generate_launch_description():
    return LaunchDescription([*ARGUMENTS, checked(player, __file__, ARGUMENTS)])
