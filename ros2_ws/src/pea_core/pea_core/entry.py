"""The first step of every program of this project, before it imports anything else.

Nothing is imported from the working directory, here and in every child: a file `yaml.py` that
lies where somebody types a command is data. Ctrl-C while modules are still being imported ends
the process without a word. What the machine refuses (a file, memory, a package) is one line.
"""

from __future__ import annotations

import errno
import importlib
import os
import signal
import sys
from collections.abc import MutableMapping
from typing import Any

SAFE = "PYTHONSAFEPATH"
"""Environment variable that keeps the working directory out of ``sys.path``."""

PATH = "PYTHONPATH"

INTERRUPTS = (signal.SIGINT, signal.SIGTERM)

FAILED = 3
"""Exit status of a program that the machine has refused something."""

PACKAGES = {"PIL": "pillow", "serial": "pyserial", "yaml": "PyYAML"}
"""Packages that are not called as the module is that they bring."""

EXTRAS = {
    **dict.fromkeys(("rclpy", "ament_index_python", "rcl_interfaces"), "ros"),
    **dict.fromkeys(("nicegui", "uvicorn", "starlette", "h11"), "dashboard"),
    **dict.fromkeys(("dask", "distributed"), "cluster"),
    **dict.fromkeys(("xarray", "h5netcdf", "nptdms"), "data"),
    "caproto": "epics",
    "pythonfmu": "fmu",
}
"""Extra of the distribution that brings a module."""

THREADLESS = ("can't start new thread", "Failed to create std::thread")
"""What Python and ROS say where no thread can be started."""

MIDDLEWARE = "RCLError"
"""Name of what rclpy raises where the middleware has failed."""


def leave_working_directory(path: list[str], env: MutableMapping[str, str]) -> None:
    """Take the working directory out of `path`, and of what children will look through.

    An empty or relative entry of ``PYTHONPATH`` is looked up in the working directory, too. An
    absolute one was meant, whatever directory it is.
    """
    here = os.getcwd()
    if not sys.flags.safe_path and path and path[0] in ("", here):
        del path[0]  # put there by `python -m`
    entries = env.get(PATH, "").split(os.pathsep) if PATH in env else []
    meant = [entry for entry in entries if os.path.isabs(entry)]
    for entry in entries:
        absolute = os.path.join(here, entry).rstrip("/")
        if entry not in meant and absolute not in meant:
            path[:] = [each for each in path if each not in (entry, absolute)]
    if meant != entries:
        env[PATH] = os.pathsep.join(meant)
    env[SAFE] = "1"


def line_of(error: BaseException) -> str | None:
    """What the machine has refused, in one line; None of an error that is another's."""
    if isinstance(error, ModuleNotFoundError) and error.name:
        name = error.name.partition(".")[0]
        if name == "pea_bench":
            return "the benchmark is not installed: run ./pea bench in a checkout of pea"
        if name.startswith("pea_"):
            return f"the package {name} of pea is not built here: make setup in its checkout"
        if name in EXTRAS:
            how = f"python3 -m pip install '.[{EXTRAS[name]}]' in a checkout of pea"
            system = ", or source a ROS 2 Jazzy" if EXTRAS[name] == "ros" else ""
            return f"the Python package {name} is missing: {how}{system}"
        package = PACKAGES.get(name, name)
        return f"the Python package {package} is missing: python3 -m pip install {package}"
    if isinstance(error, MemoryError) or any(words in str(error) for words in THREADLESS):
        return "there is not enough memory: see ulimit -v and ulimit -u, or end other programs"
    if isinstance(error, ImportError) or type(error).__name__ == MIDDLEWARE:
        return " ".join(str(error).split())
    if isinstance(error, OSError):
        why = os.strerror(error.errno) if error.errno else str(error)
        if error.errno == errno.ENOMEM:
            why += ": see ulimit -v"
        return why if error.filename is None else f"{error.filename}: {why}"
    if isinstance(error, UnicodeError):
        return f"a name or a text that is no UTF-8: {error}"
    return None


def enter(module: str, interrupted: int) -> Any:
    """Import a module and call its ``main``.

    Parameters
    ----------
    module : str
        Its name.
    interrupted : int
        Exit status of a process that is interrupted before it has done anything.
    """
    for number in INTERRUPTS:
        signal.signal(number, lambda *_: os._exit(interrupted))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, INTERRUPTS)  # who starts us may hold them back
    try:
        leave_working_directory(sys.path, os.environ)
        main = importlib.import_module(module).main
    except Exception as error:
        line = line_of(error)
        if line is None:
            raise
        print(f"{module.partition('.')[0]}: {line}", file=sys.stderr)
        sys.exit(FAILED)
    return main()
