"""How far a process looks for others, and how fast it finds them; knows no rclpy."""

from __future__ import annotations

from collections.abc import MutableMapping

from pea_core import config


def stay(env: MutableMapping[str, str]) -> None:
    """Stay on this machine and find others at once, where an environment asks for nothing else.

    Parameters
    ----------
    env : mutable mapping of str to str
        Environment of a process that has not started the middleware yet.
    """
    for name, value in (
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"),
        ("FASTRTPS_DEFAULT_PROFILES_FILE", str(config.config_dir() / "fastdds.xml")),
    ):
        env[name] = env.get(name) or value
