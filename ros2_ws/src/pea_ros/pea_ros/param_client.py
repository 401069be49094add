"""Parameters of running nodes, over the services that every ROS 2 node offers."""

from __future__ import annotations

import contextlib
import getpass
import os
import re
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient

from pea_core import config
from pea_core.config import AXIS, NODES
from pea_core.params import ParameterError, Value, nearest, typed
from pea_ros import graph
from pea_ros.context import context
from pea_ros.params import FOREIGN, ros_value
from pea_wire.topics import NAMESPACE

PATIENCE = 10.0
"""Seconds for a node to be found, and to answer."""

SILENT = 1.0
"""Seconds of waiting for a node that nothing is said of."""

KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a word"}
"""Types of parameters, as people call them."""

AUTHOR = "changed_by"
"""Parameter of a node that tells who has changed the others."""


class Client:
    """Asks nodes for their parameters, and sets them.

    Parameters
    ----------
    node : rclpy.node.Node
        Who asks; its name goes with every change.
    patience : float
        Seconds to wait for an answer.
    says : callable, optional
        Takes a line for people where nodes are not found at once.
    """

    def __init__(
        self, node: Node, patience: float = PATIENCE, says: Callable[[str], object] | None = None
    ) -> None:
        self.node = node
        self.patience = patience
        self.says = says
        self.space = node.get_namespace().rstrip("/")
        self._clients: dict[str, AsyncParameterClient] = {}

    def there(self, wanted: Sequence[str] = NODES, patience: float | None = None) -> list[str]:
        """Those of the nodes `wanted` that are there; all of them end the waiting."""
        patience = self.patience if patience is None else patience
        begin = time.monotonic()
        while True:
            known = {
                name
                for name, space in self.node.get_node_names_and_namespaces()
                if space.rstrip("/") == self.space
            }
            found = [role for role in wanted if role in known]
            waited = time.monotonic() - begin
            if len(found) == len(wanted) or waited > patience:
                return found
            self._tell(waited, [role for role in wanted if role not in found])
            time.sleep(0.05)

    @property
    def nobody(self) -> str:
        """What to say where none of the nodes is there."""
        return (
            f"no node of {self.space} is there in ROS domain {self.node.context.get_domain_id()}: "
            "start the loop first; pea run has a domain of its own, unless ROS_DOMAIN_ID is set "
            "for both"
        )

    def names(self, role: str) -> list[str]:
        """Names of a node's parameters, without those that every ROS node has."""
        answer = self._wait(role, self._of(role).list_parameters())
        return sorted(name for name in answer.result.names if not name.startswith(FOREIGN))

    def get(self, role: str, names: Sequence[str] = ()) -> dict[str, Value]:
        """Values of a node's parameters; of all, where no names are given.

        Raises
        ------
        ParameterError
            The node is not there, or does not know a name.
        """
        known = self.names(role)
        asked = list(known)
        if names:
            several = "axes" in known and any(name not in known for name in names)
            axes = _axes(self._values(role, ["axes"])) if several else (AXIS,)
            asked = list(config.spread(axes, dict.fromkeys(names)))
            _known(role, asked, known, names)
        return self._values(role, asked)

    def _values(self, role: str, names: Sequence[str]) -> dict[str, Value]:
        answer = self._wait(role, self._of(role).get_parameters(list(names)))
        values = (parameter_value_to_python(value) for value in answer.values)
        return {
            name: tuple(value) if hasattr(value, "tolist") or isinstance(value, list) else value
            for name, value in zip(names, values, strict=True)
        }

    def set(self, role: str, values: Mapping[str, object]) -> None:
        """Set parameters of a node: all of them between two samples, or none.

        Of several axes ``NAME`` sets that of every axis, ``x.NAME`` that of the axis x.

        Raises
        ------
        ParameterError
            The node is not there, or refuses; the text is its reason.
        """
        now = self.get(role)
        asked = {}
        axes = _axes(now)
        spread = config.spread(axes, values)
        if len(axes) > 1 and not any(n.rpartition(".")[2] in ("type", "preset") for n in values):
            _known(role, spread, now, values)
        for name, value in spread.items():
            asked[name] = ros_value(typed(now.get(name), value))
            _check(f"{role}.{name}", now.get(name), asked[name])
        if AUTHOR in now and AUTHOR not in asked:
            asked[AUTHOR] = self.node.get_fully_qualified_name()
        try:
            parameters = [Parameter(name, value=value) for name, value in asked.items()]
        except (TypeError, ValueError) as error:
            raise ParameterError(f"{role}: {error}") from None
        client = self._of(role)
        future = client.set_parameters_atomically(parameters)
        try:
            answer = self._wait(role, future)
        except ParameterError as error:
            raise ParameterError(f"{error}: {self._looked(role, asked)}") from None
        if not answer.result.successful:
            raise ParameterError(f"{self.space}/{role} refuses: {answer.result.reason}")

    def _looked(self, role: str, asked: Mapping[str, object]) -> str:
        """What a node has of what it was asked to set, where it did not say in time."""
        names = [name for name in asked if name != AUTHOR]
        try:
            now = self.get(role, names)
        except ParameterError:
            return f"it may have set them or not; look with pea param get {role} {' '.join(names)}"
        done = [name for name in names if ros_value(now[name]) == asked[name]]
        told = ", ".join(f"{name} = {now[name]}" for name in names)
        return f"{'it has set them nevertheless' if done == names else 'not set so far'}: {told}"

    def _of(self, role: str) -> AsyncParameterClient:
        if role not in self._clients:
            client = AsyncParameterClient(self.node, f"{self.space}/{role}")
            begin = time.monotonic()
            while not client.services_are_ready():
                waited = time.monotonic() - begin
                if waited > self.patience:
                    there = ", ".join(self.there(patience=0.0))
                    raise ParameterError(
                        f"{self.space}/{role} is not there (running: {there}): start it first"
                        if there
                        else self.nobody
                    )
                self._tell(waited, [role])
                time.sleep(0.02)
            self._clients[role] = client
        return self._clients[role]

    def _tell(self, waited: float, roles: Sequence[str]) -> None:
        """Say once whom the waiting is for, where it is long."""
        if self.says is not None and waited > SILENT:
            missing = ", ".join(f"{self.space}/{role}" for role in roles)
            self.says(f"waits for {missing}, at most {self.patience:g} s")
            self.says = None

    def _wait(self, role: str, future: Any) -> Any:
        rclpy.spin_until_future_complete(self.node, future, timeout_sec=self.patience)
        if not future.done():
            raise ParameterError(f"{self.space}/{role} does not answer within {self.patience:g} s")
        return future.result()


def _axes(values: Mapping[str, Any]) -> tuple[str, ...]:
    """Axes of a node, from its parameters."""
    return tuple(values.get("axes") or (AXIS,))


def _known(role: str, asked: Iterable[str], known: Collection[str], names: Iterable[str]) -> None:
    """See that a node has all that it is asked for; `names` as somebody has typed them.

    Raises
    ------
    ParameterError
        It does not.
    """
    for each in asked:
        if each not in known:
            typed_so = next(n for n in names if n == each or each.endswith(f".{n}"))
            advice = nearest(typed_so, sorted(known), f"{role}.")
            raise ParameterError(f"unknown parameter {role}.{typed_so}: {advice}")


def _check(name: str, old: object, value: object) -> None:
    """See that a value has the type of the one there: the node would not name what it refuses.

    Raises
    ------
    ParameterError
        It is of another type.
    """
    for kind, rule in KINDS.items():
        if type(old) is kind and type(value) is not kind:
            raise ParameterError(f"{name} = {value!r}: give {rule}")


@contextlib.contextmanager
def client(
    name: str | None = None,
    namespace: str = NAMESPACE,
    says: Callable[[str], object] | None = None,
) -> Iterator[Client]:
    """A client with a node of its own, for as long as it is used.

    Parameters
    ----------
    name : str, optional
        Name of the node, which goes with every change; else that of the user.
    namespace : str
        Where the nodes are.
    says : callable, optional
        See `Client`.

    Raises
    ------
    ParameterError
        There is no such ROS domain, or the middleware does not start.
    """
    graph.check_domain()
    with context():
        node = Node(
            name or f"param_{_user()}",
            namespace=namespace,
            use_global_arguments=False,
            start_parameter_services=False,
        )
        try:
            yield Client(node, says=says)
        finally:
            node.destroy_node()


def _user() -> str:
    """Name of the user as part of a node's; the number where a container knows no name."""
    try:
        return re.sub(r"\W", "_", getpass.getuser(), flags=re.ASCII)
    except (KeyError, OSError):
        return str(os.getuid())
