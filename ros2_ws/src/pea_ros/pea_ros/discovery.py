"""How far a process looks for others, and how fast it finds them; knows no rclpy."""

from __future__ import annotations

from collections.abc import MutableMapping

from pea_core import config

RANGE, PROFILE = "ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE"


def stay(env: MutableMapping[str, str]) -> None:
    """Stay on this machine and find others at once, where an environment asks for nothing else.

    The profile for this machine opens sockets on 127.0.0.1 alone; who asks for another range gets
    the one for a network.

    Parameters
    ----------
    env : mutable mapping of str to str
        Environment of a process that has not started the middleware yet.
    """
    env[RANGE] = env.get(RANGE) or "LOCALHOST"
    here = env[RANGE] in ("LOCALHOST", "OFF") and not env.get("ROS_STATIC_PEERS")
    profile = config.config_dir() / ("fastdds.xml" if here else "fastdds_network.xml")
    env[PROFILE] = env.get(PROFILE) or str(profile)
