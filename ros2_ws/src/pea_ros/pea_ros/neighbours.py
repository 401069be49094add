"""The parameters of the other nodes of the loop, with which a node checks its own parameters.

The loop never waits for them: they are requested in the background, and parameter events report
later changes. The check needs to know every block, so it is not part of this layer: a package that
offers one registers an entry point in the group `JUDGE`. If there is none, a node warns that gains
are not judged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from importlib.metadata import entry_points
from typing import Any

from rcl_interfaces.msg import ParameterEvent
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

from pea_wire import events
from pea_wire.convert import ConversionError

LOOK_EVERY = 0.5
"""Seconds between two attempts to ask a neighbour."""

JUDGE = "pea.judge"
"""Group of entry points; each is called with (values, role, params, warn) and may refuse them."""


@cache
def judges() -> tuple[Callable[..., None], ...]:
    """All installed checks."""
    return tuple(found.load() for found in entry_points(group=JUDGE))


class Remote:
    """Reads the parameters of another node; it has no client that sets parameters.

    Parameters
    ----------
    node : rclpy.node.Node
        The node that asks.
    name : str
        Full name of the other node.
    """

    def __init__(self, node: Node, name: str) -> None:
        self._list = node.create_client(ListParameters, f"{name}/list_parameters")
        self._get = node.create_client(GetParameters, f"{name}/get_parameters")

    def ready(self) -> bool:
        """Whether the other node serves its parameters."""
        return bool(self._list.service_is_ready() and self._get.service_is_ready())

    def list_names(self) -> Any:
        """Future of an answer with ``result.names``."""
        return self._list.call_async(ListParameters.Request())

    def get(self, names: Sequence[str]) -> Any:
        """Future of an answer with ``values``, one for each name."""
        return self._get.call_async(GetParameters.Request(names=list(names)))


class Neighbours:
    """Parameters of other nodes, as far as they are known.

    Parameters
    ----------
    node : rclpy.node.Node
        The node that asks.
    role : str
        Block of this node.
    others : sequence of str
        Blocks whose parameters are needed.
    find : callable
        Returns the full name of a block's node.

    Attributes
    ----------
    changed : callable
        Called with a block and its changed parameters by name.
    """

    def __init__(
        self, node: Node, role: str, others: Sequence[str], find: Callable[[str], str]
    ) -> None:
        self.node = node
        self.role = role
        self.values: dict[str, dict[str, Any]] = {}
        self.changed: Callable[[str, dict[str, Any]], None] = lambda other, values: None
        self.others = tuple(others)
        self._find = find
        self._names: dict[str, str] = {}
        self._clients: dict[str, Remote] = {}
        self._asked: set[str] = set()
        self._timer = node.create_timer(
            LOOK_EVERY, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        node.create_subscription(ParameterEvent, "/parameter_events", self._heard, 100, raw=True)

    @property
    def known(self) -> bool:
        """Whether all of them have reported their parameters."""
        return all(other in self.values for other in self.others)

    def _look(self) -> None:
        """Ask the nodes that were not asked yet."""
        for other in self.others:
            if other in self._asked:
                continue
            name = self._find(other)
            if self._names.get(other) != name:
                self._names[other] = name
                self._clients[other] = Remote(self.node, name)
            if self._clients[other].ready():
                self._asked.add(other)
                self._ask(other, self._clients[other])
        if self._asked == set(self.others):
            self._timer.cancel()

    def _ask(self, other: str, client: Remote) -> None:
        def listed(future: Any) -> None:
            names = future.result().result.names

            def got(future: Any) -> None:
                answers = future.result().values  # empty if the node does not know a name
                known = {n: parameter_value_to_python(v) for n, v in zip(names, answers)}
                self.values[other] = known | self.values.get(other, {})

            client.get(names).add_done_callback(got)

        client.list_names().add_done_callback(listed)

    def _heard(self, data: bytes) -> None:
        try:
            event = events.decode(data)
        except ConversionError:  # any node may publish here; the recorder reports such messages
            return
        other = event.node.rpartition("/")[2]
        if other in self.others and event.node == (self._names.get(other) or self._find(other)):
            changed = {**event.changed, **event.new}
            self.values.setdefault(other, {}).update(changed)
            self.changed(other, changed)

    def judge(self, own: dict[str, object], params: object, warn: Callable[[str], object]) -> None:
        """Refuse parameters with which theory finds the loop unstable, or its margins too small.

        Parameters
        ----------
        own : dict
            Present values of this node, with its sample period.
        params : dataclass
            The new parameters.
        warn : callable
            Called with a text if a check warns only.

        Raises
        ------
        ParameterError
            The parameters are refused.
        """
        if not self.known:
            return  # the loop does not run yet, or not with our nodes
        if not judges():
            warn(f"gains are not judged: no entry point {JUDGE} is installed")
        for judge in judges():
            judge({**self.values, self.role: own}, self.role, params, warn)
