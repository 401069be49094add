"""The ways that samples can take over DDS, and which one the user asks for; knows no rclpy."""

from __future__ import annotations

import os

from pea_core.params import ParameterError, nearest

NAIVE, FAST, TURBO = PATHS = ("naive", "fast", "turbo")

SWITCH = "PEA_TRANSPORT"
"""Environment variable that names one of `PATHS`; unset, the best that passes its probe."""

PROGRESS = "PEA_PROGRESS"
"""Environment variable that names a file in which the plant tells how many samples are done."""


def chosen() -> str:
    """What the user asks for: one of `PATHS`, or nothing.

    Raises
    ------
    ParameterError
        It is none of these.
    """
    path = os.environ.get(SWITCH, "")
    if path and path not in PATHS:
        raise ParameterError(f"{SWITCH} = {path!r}: {nearest(path, PATHS)}")
    return path
