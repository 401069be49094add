"""The four nodes with the simulated actuator, from one experiment file, and the recorder.

ros2 launch pea_bringup sim.launch.py experiment:=fig9_hysteresis_10hz bag:=$PWD/runs/mine

With namespace:=stage1, or included under PushRosNamespace("stage1"), topics are /stage1/voltage and
so on, nodes /stage1/plant and so on; without, /pea/voltage.

Nothing is computed here: nodes and files are picked. The nodes come in any order, wait for each
other, and start the loop by themselves.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration

from pea_bringup.parts import (
    BAG,
    SPACE,
    block,
    checked,
    discovery,
    file,
    given,
    named,
    path_of,
    recorder,
)

ARGUMENTS = (
    named(
        "experiment", "fig9_hysteresis_10hz", "name of a file in config/experiments/, without .yaml"
    ),
    path_of(
        "params",
        "experiment",
        "the file itself; a path that is absolute may lie anywhere, as params.yaml of a run",
    ),
    BAG,
    SPACE,
    DeclareLaunchArgument(
        "transport",
        default_value="",
        description="naive, fast or turbo; empty: the best there is",
        choices=["", "naive", "fast", "turbo"],
    ),
)


def nodes(space):
    params = file("experiments", "params")
    blocks = ("plant", "observer", "controller", "reference")
    return [recorder(space, params), *(block(space, name, params) for name in blocks)]


def generate_launch_description():
    transport = SetEnvironmentVariable(
        "PEA_TRANSPORT", LaunchConfiguration("transport"), condition=IfCondition(given("transport"))
    )
    start = checked(nodes, __file__, ARGUMENTS, params=("experiments", "experiment"))
    return LaunchDescription([*ARGUMENTS, *discovery(), transport, start])
