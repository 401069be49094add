"""The ROS graph that a command joins: which domain, and which way over DDS."""

from __future__ import annotations

import os

from pea_ros.paths import chosen
from pea_runtime.options import whole

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
    if domain:
        whole("ROS_DOMAIN_ID", domain, 0, DOMAIN_MAX)
