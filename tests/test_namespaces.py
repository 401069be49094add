"""Names of a node's topics and neighbours follow its namespace and its remaps."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import rclpy
from rclpy.node import Node

from pea_cli import param as param_cli
from pea_core.config import NAMESPACE
from pea_core.params import ParameterError
from pea_ros.transport import full_name
from pea_wire.topics import (
    CONSUMED,
    DIAGNOSTICS,
    DISPLACEMENT,
    PARAMETER_EVENTS,
    STATE,
    VOLTAGE,
    Topic,
    blocks_of,
)


@contextmanager
def node(*arguments: str) -> Iterator[Any]:
    """A node of ours as a process with these ROS arguments has it."""
    context = rclpy.Context()
    rclpy.init(args=["--ros-args", *arguments], context=context)
    try:
        yield Node(
            "controller",
            namespace=NAMESPACE,
            context=context,
            enable_rosout=False,
            start_parameter_services=False,
        )
    finally:
        context.try_shutdown()


CASES: dict[str, tuple[tuple[str, ...], dict[Topic, str]]] = {
    "by default": ((), {VOLTAGE: "/pea/voltage", blocks_of(VOLTAGE): "/pea/voltage/blocks"}),
    "a namespace stands for pea": (
        ("-r", "__ns:=/stage1"),
        {
            VOLTAGE: "/stage1/voltage",
            CONSUMED: "/stage1/consumed",
            blocks_of(STATE): "/stage1/state/blocks",
            DIAGNOSTICS: "/diagnostics",
            PARAMETER_EVENTS: "/parameter_events",
        },
    ),
    "one in another": (("-r", "__ns:=/lab/a"), {DISPLACEMENT: "/lab/a/displacement"}),
    "blocks follow a remap": (
        ("-r", "voltage:=/b/u"),
        {VOLTAGE: "/b/u", blocks_of(VOLTAGE): "/b/u/blocks", STATE: "/pea/state"},
    ),
    "a remap by full name": (("-r", "/pea/state:=/b/state"), {STATE: "/b/state"}),
}


@pytest.mark.parametrize(("arguments", "names"), CASES.values(), ids=CASES)
def test_topics_are_where_the_user_puts_them(arguments, names):
    with node(*arguments) as made:
        assert {topic: full_name(made, topic) for topic in names} == names


@pytest.mark.parametrize("text", ["stage1", "/stage1", "/stage1/"])
def test_a_namespace_is_given_with_or_without_slash(text):
    assert param_cli.space(text.rstrip("/")) == "/stage1"
    assert param_cli.role("/stage1/controller", "/stage1") == "controller"


@pytest.mark.parametrize("text", ["", "/", "a b", "1a", "a//b", "/**"])
def test_a_namespace_that_is_none_is_refused(text):
    with pytest.raises(ParameterError, match="--namespace"):
        param_cli.space(text)
