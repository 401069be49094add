"""Memory that a ROS process must have: the middleware aborts without a word where it has less."""

from __future__ import annotations

import os
import resource

from pea_core.params import ParameterError

ADDRESSES = 1_500_000
"""Address space of a process (kB) that Python, ROS and the kernels of the loop need."""

SHARED = 8_000
"""Shared memory (kB) that the processes of a loop need to talk to each other."""

FOLDER = "/dev/shm"


def check_room() -> None:
    """Refuse a process that would be aborted later.

    Where shared memory cannot be written at all, the middleware goes without it.

    Raises
    ------
    ParameterError
        The limit of the address space is too low, or shared memory is full.
    """
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY and limit < ADDRESSES * 1024:
        raise ParameterError(
            f"ulimit -v {limit // 1024}: a ROS process needs {ADDRESSES} kB; "
            "raise it; mode batch needs less"
        )
    try:
        found = os.statvfs(FOLDER)
    except OSError:
        return
    free = found.f_bavail * found.f_frsize // 1024
    if found.f_blocks and not found.f_flag & os.ST_RDONLY and free < SHARED:
        raise ParameterError(
            f"{FOLDER}: {free} kB are free, ROS processes need {SHARED} kB; "
            "remove files there, or enlarge it; mode batch needs none"
        )
