"""Shared memory that killed nodes leave behind: Fast DDS removes its files at a clean end only."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

FOLDER = Path("/dev/shm")
PATTERNS = ("fastrtps_*", "sem.fastrtps_*")
LOCK = "_el"
"""Ending of a lock file, which lies beside the file that it guards."""


def files() -> set[Path]:
    """Fast DDS's files of every process."""
    return {path for pattern in PATTERNS for path in FOLDER.glob(pattern)}


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


@contextlib.contextmanager
def swept() -> Iterator[None]:
    """Remove what came meanwhile and nobody uses any more."""
    before = files()
    try:
        yield
    finally:
        new = files() - before
        used = mapped()
        for path in new:
            if str(path).removesuffix(LOCK) not in used:
                with contextlib.suppress(OSError):
                    path.unlink()
