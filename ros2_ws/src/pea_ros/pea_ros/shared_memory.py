"""Shared memory that killed nodes leave behind: Fast DDS removes its files at a clean end only.

A segment has up to three files: itself, the lock that tells the living from the dead, and the
mutex of a port. They go together or not at all: a port that has lost its lock alone counts as
alive for ever, and swallows what later nodes of the same ROS domain send each other.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

FOLDER = Path("/dev/shm")
LOCK = "_el"
MUTEX = ("sem.", "_mutex")

SETTLE = 0.1
"""Seconds between two looks: a file that somebody has just made is not in use yet."""


def segments() -> dict[str, set[Path]]:
    """Files of every Fast DDS segment, of whatever process, by its name."""
    found: dict[str, set[Path]] = defaultdict(set)
    before, behind = MUTEX
    for path in (*FOLDER.glob("fastrtps_*"), *FOLDER.glob(f"{before}fastrtps_*")):
        name = path.name
        if name.startswith(before):
            name = name.removeprefix(before).removesuffix(behind)
        found[name.removesuffix(LOCK)].add(path)
    return found


def mapped() -> set[str]:
    """Files in shared memory that a living process uses."""
    used: set[str] = set()
    for maps in Path("/proc").glob("[0-9]*/maps"):
        with contextlib.suppress(OSError):
            used.update(
                line.rsplit(" ", 1)[1]
                for line in maps.read_text(errors="replace").splitlines()
                if f" {FOLDER}/" in line
            )
    return used


def dead() -> dict[str, set[Path]]:
    """Segments that nobody uses."""
    found = segments()  # first: what comes into use meanwhile must not look unused
    used = mapped() if found else set()
    return {
        name: files
        for name, files in found.items()
        if not any(str(path) in used for path in files) and not _locked(FOLDER / (name + LOCK))
    }


def _locked(lock: Path) -> bool:
    """Whether a process holds `lock`, be it one whose memory is not ours to see."""
    try:
        descriptor = os.open(lock, os.O_RDONLY)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False


def sweep() -> None:
    """Remove every segment that nobody uses, in two looks."""
    first = dead()
    if not first:
        return
    time.sleep(SETTLE)
    for name, files in dead().items():
        if files == first.get(name):
            for path in sorted(files, key=lambda path: path.name.endswith(LOCK)):
                with contextlib.suppress(OSError):
                    path.unlink()


@contextlib.contextmanager
def swept() -> Iterator[None]:
    """Remove before and after what dead nodes have left."""
    sweep()
    try:
        yield
    finally:
        sweep()
