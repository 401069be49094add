"""The ROS graph that a command joins: which domain, and how far it reaches."""

from __future__ import annotations

import os
from collections.abc import MutableMapping

from pea_core import config
from pea_core.params import ParameterError
from pea_ros.paths import chosen

DOMAIN_MAX = 232
"""Last ROS domain that UDP has ports for."""


def check_domain() -> None:
    """Refuse a domain, or a way over DDS, that there is not.

    Raises
    ------
    ParameterError
        ``ROS_DOMAIN_ID`` or ``PEA_TRANSPORT`` is none.
    """
    chosen()
    domain = os.environ.get("ROS_DOMAIN_ID")
    if domain and not (domain.isdecimal() and int(domain) <= DOMAIN_MAX):
        raise ParameterError(f"ROS_DOMAIN_ID = {domain!r}: must be 0 to {DOMAIN_MAX}")


def stay(env: MutableMapping[str, str]) -> None:
    """Stay on this machine and find others at once, where an environment asks for nothing else."""
    for name, value in (
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"),
        ("FASTRTPS_DEFAULT_PROFILES_FILE", str(config.config_dir() / "fastdds.xml")),
    ):
        env[name] = env.get(name) or value


def join() -> None:
    """`stay` in this process.

    Raises
    ------
    ParameterError
        As `check_domain`.
    """
    check_domain()
    stay(os.environ)
