"""The four nodes on a rig in wall time: plant, observer and controller as the rig's file says.

ros2 launch pea_bringup rig.launch.py rig:=e727_emulated experiment:=fig9_hysteresis_10hz
ros2 launch pea_bringup rig.launch.py namespace:=stage2    # a second stage in the same domain

Of the experiment comes the reference alone. The plant's node is a lifecycle node, /pea/plant: it
configures and activates itself when its neighbours are there, and `ros2 lifecycle set /pea/plant
deactivate` brings the voltage to rest; a launch file that includes this one can wait for its
transitions (`OnStateTransition`). Nothing is computed here: nodes and files are picked.
"""

from launch import LaunchDescription
from launch_ros.actions import LifecycleNode

from pea_bringup.parts import (
    BAG,
    SPACE,
    block,
    checked,
    discovery,
    file,
    named,
    path_of,
    recorder,
)

ARGUMENTS = (
    named("rig", "simulated_200hz", "name of a file in config/rigs/, without .yaml"),
    named(
        "experiment",
        "fig9_hysteresis_10hz",
        "whose reference is followed: a file in config/experiments/, without .yaml",
    ),
    path_of("rig_params", "rig", "the rig's file itself; an absolute path may lie anywhere"),
    path_of("params", "experiment", "the experiment's file itself; likewise"),
    BAG,
    SPACE,
)


def nodes(space):
    rig, experiment = file("rigs", "rig_params"), file("experiments", "params")
    return [
        recorder(space, rig),
        block(space, "plant", rig, {"clock": "wall"}, kind=LifecycleNode, name="plant"),
        block(space, "observer", rig),
        block(space, "controller", rig),
        block(space, "reference", experiment, rig),
    ]


def generate_launch_description():
    files = {"rig_params": ("rigs", "rig"), "params": ("experiments", "experiment")}
    start = checked(nodes, __file__, ARGUMENTS, **files)
    return LaunchDescription([*ARGUMENTS, *discovery(), start])
