"""Which way a node's samples take over DDS: the fastest one that a probe finds to work here."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Any

from rclpy.node import Node

from pea_engine.compiled import wanted
from pea_ros.paths import FAST, NAIVE, SWITCH, TURBO, chosen
from pea_ros.transport import PROBE, Inbox, Outbox
from pea_wire import convert
from pea_wire.topics import JOINT_STATE, NAMESPACE, Topic


def probe(node: Node, exchange: Callable[[Any, Any, bytes], bytes]) -> None:
    """Send a message to this process itself over DDS and compare what comes.

    Parameters
    ----------
    node : rclpy.node.Node
    exchange : callable
        Gets an `Outbox`, an `Inbox` and the bytes; sends, waits and returns what it took.

    Raises
    ------
    Exception
        What came differs from what was sent; the text says how.
    """
    name = f"{NAMESPACE}/_probe_{node.get_name()}_{os.getpid()}"  # hidden from listings
    topic = Topic(name, JOINT_STATE, 1, "", ())
    outbox, inbox = Outbox(node, topic), Inbox(node, topic, best_effort=True)
    try:
        sent = convert.forms().state.encode(1_234_567_890, 1.5, -2.5, 3.5)
        come = exchange(outbox, inbox, sent)
        if come != sent:
            raise OSError(f"sent {sent.hex()}, got {come.hex()}")
    finally:
        node.destroy_publisher(outbox.publisher)
        inbox.close(node)


def by_hand(outbox: Outbox, inbox: Inbox, data: bytes) -> bytes:
    """The exchange of ``fast``, for `probe`."""
    outbox.send(data)
    inbox.wait(PROBE)
    return inbox.take() or b""


def compiles(samples: int) -> bool:
    """Whether the blocks of a run of so many samples are compiled in their nodes."""
    return wanted(sys.maxsize if chosen() == TURBO else samples)


def path_for(node: Node, samples: int) -> tuple[str, str]:
    """The transport to use, and why.

    Parameters
    ----------
    node : rclpy.node.Node
    samples : int
        Length of the run: a short one is not worth the compiling.

    Raises
    ------
    ParameterError
        The user asks for a transport that does not work here.
    """
    wish = chosen()
    if wish == NAIVE:
        return NAIVE, f"{SWITCH} asks for it"
    try:
        probe(node, by_hand)
    except Exception as error:  # another version of rclpy may raise anything
        return NAIVE, f"fast fails its probe: {_line(error)}"
    if wish == FAST:
        return FAST, f"{SWITCH} asks for it"
    if not compiles(samples):
        return FAST, "nothing is compiled: a short run, no numba, or PEA_COMPILE=0"
    try:
        from pea_ros import turbo

        probe(node, turbo.by_librcl)
    except Exception as error:
        return FAST, f"turbo fails its probe: {_line(error)}"
    return TURBO, f"{SWITCH} asks for it" if wish else "its probe came back whole"


def _line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
