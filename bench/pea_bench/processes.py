"""Yardsticks that are processes of their own, started and ended by the bench."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator

from pea_ros import shared_memory
from pea_run.modes.distributed import environment

PATIENCE = 60.0
"""Seconds beyond its own length after which a process counts as stuck."""


@contextlib.contextmanager
def peers(module: str, *rows: tuple[str, ...]) -> Iterator[list[subprocess.Popen[str]]]:
    """One process for each row of arguments, in a ROS domain of their own; ended at the end.

    Parameters
    ----------
    module : str
        In ``pea_bench.peers``.
    rows : tuple of tuple of str
        Arguments of each process.
    """
    started: list[subprocess.Popen[str]] = []
    with shared_memory.swept(), environment() as (env, held):
        try:
            started += [
                subprocess.Popen(
                    [sys.executable, "-m", f"pea_bench.peers.{module}", *arguments],
                    env=env,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    text=True,
                    start_new_session=True,
                    pass_fds=held,
                )
                for arguments in rows
            ]
            yield started
        finally:
            for process in started:
                process.kill()
                process.wait()
                if process.stdout is not None:
                    process.stdout.close()


def figure(process: subprocess.Popen[str], seconds: float) -> float:
    """The number that a yardstick prints at its end.

    Raises
    ------
    subprocess.TimeoutExpired
        It did not end in its own time and `PATIENCE`.
    ValueError
        It printed none.
    """
    told, _ = process.communicate(timeout=seconds + PATIENCE)
    return float(told)
