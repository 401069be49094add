"""The ROS graph that a command joins: which domain, and which way over DDS."""

from __future__ import annotations

import os

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
