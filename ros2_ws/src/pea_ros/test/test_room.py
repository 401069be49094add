"""A ROS process is refused where the middleware would abort for lack of memory."""

from __future__ import annotations

import os
import resource
from types import SimpleNamespace

import pytest

from pea_core.params import ParameterError
from pea_ros import room


@pytest.fixture
def machine(monkeypatch):
    """Give this process a limit of its addresses (kB), and shared memory (kB)."""

    def give(limit: int | None = None, free: int = 1 << 20, flags: int = 0, size: int = 1) -> None:
        bytes_ = resource.RLIM_INFINITY if limit is None else limit * 1024
        monkeypatch.setattr(resource, "getrlimit", lambda what: (bytes_, bytes_))
        found = SimpleNamespace(f_bavail=free, f_frsize=1024, f_blocks=size, f_flag=flags)
        monkeypatch.setattr(os, "statvfs", lambda path: found)

    return give


@pytest.mark.parametrize("limit", [0, 400_000, room.ADDRESSES - 1])
def test_too_few_addresses_are_refused(machine, limit):
    machine(limit)
    with pytest.raises(ParameterError, match=rf"^ulimit -v {limit}: .* {room.ADDRESSES} kB"):
        room.check_room()


@pytest.mark.parametrize("free", [0, 64, room.SHARED - 1])
def test_full_shared_memory_is_refused(machine, free):
    machine(free=free)
    with pytest.raises(ParameterError, match=rf"^/dev/shm: {free} kB are free"):
        room.check_room()


@pytest.mark.parametrize(
    "found",
    [
        {},
        {"limit": room.ADDRESSES},
        {"free": room.SHARED},
        {"free": 0, "flags": os.ST_RDONLY},
        {"free": 0, "size": 0},
    ],
    ids=["unlimited", "addresses", "shared", "read-only", "without a limit"],
)
def test_enough_is_taken(machine, found):
    machine(**found)
    room.check_room()


def test_a_machine_without_shared_memory_is_taken(monkeypatch, tmp_path):
    monkeypatch.setattr(room, "FOLDER", str(tmp_path / "none"))
    room.check_room()
