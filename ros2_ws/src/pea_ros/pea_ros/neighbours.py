"""What a node knows of its neighbours' parameters, so that its own are judged with theirs.

Nothing waits for it: neighbours are asked beside the loop, and their parameter events tell of what
they change. Who judges has to know every block, so it is no part of this layer: whoever does
registers an entry point in the group `JUDGE`. Where nobody has, a node says that nothing is judged.
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
    """All that are installed."""
    return tuple(found.load() for found in entry_points(group=JUDGE))


class Remote:
    """The parameters of another node, to be read: no client that sets any is opened.

    Parameters
    ----------
    node : rclpy.node.Node
        Who asks.
    name : str
        Full name of the other node.
    """

    def __init__(self, node: Node, name: str) -> None:
        self._list = node.create_client(ListParameters, f"{name}/list_parameters")
        self._get = node.create_client(GetParameters, f"{name}/get_parameters")

    def ready(self) -> bool:
        """Whether it serves them."""
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
        Who asks.
    role : str
        Its own block.
    others : sequence of str
        Blocks whose parameters count.
    find : callable
        Gives the full name of a block's node.

    Attributes
    ----------
    changed : callable
        Told of a neighbour's parameters that have changed, by name.
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
        """Ask whom nobody has asked yet."""
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
                answers = future.result().values  # none for a name of another make
                known = {n: parameter_value_to_python(v) for n, v in zip(names, answers)}
                self.values[other] = known | self.values.get(other, {})

            client.get(names).add_done_callback(got)

        client.list_names().add_done_callback(listed)

    def _heard(self, data: bytes) -> None:
        try:
            event = events.decode(data)
        except ConversionError:  # anybody may publish here, and the recorder says so
            return
        other = event.node.rpartition("/")[2]
        if other in self.others and event.node == (self._names.get(other) or self._find(other)):
            changed = {**event.changed, **event.new}
            self.values.setdefault(other, {}).update(changed)
            self.changed(other, changed)

    def judge(self, own: dict[str, object], params: object, warn: Callable[[str], object]) -> None:
        """Refuse parameters with which theory finds the loop unstable, or of too little margin.

        Parameters
        ----------
        own : dict
            This node's values as they are, its sample period among them.
        params : dataclass
            What they shall be.
        warn : callable
            Told what is not refused.

        Raises
        ------
        ParameterError
            They are refused.
        """
        if not self.known:
            return  # the loop does not run yet, or not with our nodes
        if not judges():
            warn(f"gains are not judged: no entry point {JUDGE} is installed")
        for judge in judges():
            judge({**self.values, self.role: own}, self.role, params, warn)
