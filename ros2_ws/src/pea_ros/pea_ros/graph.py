"""The ROS graph that a command joins: which domain, and which way over DDS."""

from __future__ import annotations

import os

from pea_core.params import ParameterError, Spec
from pea_ros import shared_memory
from pea_ros.paths import chosen
from pea_ros.room import check_room

DOMAIN_MAX = 232
"""Last ROS domain that UDP has ports for."""


def check_domain() -> None:
    """Refuse a domain, or a way over DDS, that there is not, and too little memory for ROS.

    Raises
    ------
    ParameterError
        ``ROS_DOMAIN_ID`` or ``PEA_TRANSPORT`` is none, or memory is short.
    """
    chosen()
    domain = os.environ.get("ROS_DOMAIN_ID")
    if domain:
        Spec(low=0, high=DOMAIN_MAX, kind=int).check("ROS_DOMAIN_ID", domain)
    try:
        check_room()
    except ParameterError:  # killed processes may have left it full
        shared_memory.sweep()
        check_room()
