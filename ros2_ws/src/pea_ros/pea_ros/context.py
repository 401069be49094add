"""The ROS graph from within a process, from the middleware's start to its end."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import Executor, ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.signals import SignalHandlerOptions

from pea_core import parameter_file
from pea_core.loop import LoopFault
from pea_core.params import ParameterError
from pea_ros.discovery import stay
from pea_ros.room import check_room
from pea_wire.convert import ConversionError

ENDS = (
    LoopFault,
    ConversionError,
    ParameterError,
    ExternalShutdownException,
    rclpy_implementation.RCLError,
)
"""What ends a process while it serves: the loop goes on meanwhile, and may fail."""

UNLOGGED = ("--ros-args", "--disable-external-lib-logs")
"""ROS arguments with which the middleware writes no log file of its own."""


def loggable(args: Sequence[str]) -> list[str]:
    """ROS arguments; without a log file of the middleware where its folder cannot be written."""
    env = os.environ
    home = env.get("ROS_HOME") or f"{env.get('HOME', '')}/.ros"
    folder = Path(env.get("ROS_LOG_DIR") or f"{home}/log").expanduser()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        written = os.access(folder, os.W_OK)
    except OSError:
        written = False
    return [*args, *(() if written else UNLOGGED)]


class GivenParameters:
    """Parameters that a process was given as ROS arguments.

    Attributes
    ----------
    files : dict
        Sections of each parameter file.
    values : list of tuple
        Section, name and value of each ``-p [node:]name:=value``.
    """

    def __init__(self) -> None:
        self.files: dict[Path, dict[str, dict[str, Any]]] = {}
        self.values: list[tuple[str, str, Any]] = []

    def read(self, args: Sequence[str]) -> None:
        """Read arguments as ROS does.

        Raises
        ------
        ParameterError
            A file or a value does not mean the same to every reader.
        """
        self.files, self.values = {}, []
        words, ros = iter(args), False
        for word in words:
            ros = (ros or word == "--ros-args") and word != "--"
            if ros and word == "--params-file" and (file := next(words, "")):
                self.files[Path(file)] = parameter_file.sections(Path(file))
            elif ros and word in ("-p", "--param"):
                rule = next(words, "")
                name, assigns, text = rule.partition(":=")
                section, _, name = name.rpartition(":")
                if assigns:
                    self.values.append((section or "/**", name, _value(rule, text)))


def _value(rule: str, text: str) -> Any:
    try:
        return parameter_file.value(text)
    except ParameterError as error:
        raise ParameterError(f"-p {rule}: {error}") from None


given = GivenParameters()
"""What this process was given."""


def serve_once(executor: Executor, wait: float, warn: Callable[[str], object]) -> None:
    """Serve what another node has asked or said; what cannot be served ends nothing.

    rclpy's own services raise on a request that they do not understand, a parameter of an unknown
    type for example. Who has asked gets no answer.

    Parameters
    ----------
    executor : rclpy.executors.Executor
    wait : float
        Seconds to wait for anything.
    warn : callable
        Told what was not served.

    Raises
    ------
    Exception
        One of `ENDS`.
    """
    try:
        executor.spin_once(timeout_sec=wait)
    except ENDS:
        raise
    except Exception as error:  # whatever rclpy raises on foreign input
        said = " ".join(f"{type(error).__name__}: {error}".split())
        warn(f"a request of another node is not served: {said[:200]}")


@contextlib.contextmanager
def context(args: Sequence[str] | None = (), signals: bool = False) -> Iterator[None]:
    """Start the middleware, on this machine if nobody asks for more; end it whatever happens.

    Parameters
    ----------
    args : sequence of str, optional
        ROS arguments; those of the process where None.
    signals : bool
        Whether rclpy's own handlers of SIGINT and SIGTERM end it, too.

    Raises
    ------
    ParameterError
        It does not start with these arguments, in this environment, or with so little memory.
    """
    check_room()
    stay(os.environ)
    given.read(sys.argv if args is None else args)
    options = SignalHandlerOptions.ALL if signals else SignalHandlerOptions.NO
    try:
        told = loggable(sys.argv if args is None else args)
        rclpy.init(args=told, signal_handler_options=options)
    except rclpy_implementation.UnknownROSArgsError as error:
        raise ParameterError(f"unknown ROS arguments {error}: see ros2 run --help") from None
    except rclpy_implementation.RCLError as error:
        rclpy.try_shutdown()  # it remembers a start that failed
        raise ParameterError(" ".join(str(error).split())) from None
    try:
        yield
    finally:
        rclpy.try_shutdown()
