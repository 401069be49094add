"""The table of all topics: name, type, QoS, publisher, subscribers. It does not use rclpy."""

from __future__ import annotations

from typing import NamedTuple

from pea_core.config import AXIS as AXIS
from pea_core.config import NAMESPACE as NAMESPACE

RECORDER = "recorder"
"""Name of the recorder's node, and of its executable."""

WINDOW = 2000
"""Samples that the plant may be ahead of the recorder, and history kept for it."""


class Topic(NamedTuple):
    """One topic. Publishers offer reliable, keep last `depth`, so any subscriber matches.

    Attributes
    ----------
    name : str
        Full name in the default namespace; a node's own namespace and remaps stand for it there.
    type : str
        Message type, ``package/msg/Type``.
    depth : int
        History kept for subscribers that lag, in messages.
    publisher : str
        Node that publishes.
    subscribers : tuple of str
        Nodes that must listen before the loop can start.
    latched : bool
        Whether late subscribers get the last messages (transient local).
    """

    name: str
    type: str
    depth: int
    publisher: str
    subscribers: tuple[str, ...]
    latched: bool = False

    @property
    def relative(self) -> str:
        """Name as a node asks for it: without the namespace, where it is in one."""
        return self.name.removeprefix(f"{NAMESPACE}/")

    def at(self, namespace: str) -> str:
        """Full name in a namespace."""
        relative = self.relative
        return relative if relative.startswith("/") else f"{namespace.rstrip('/')}/{relative}"


JOINT_STATE = "sensor_msgs/msg/JointState"
JOINT_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
TIME = "builtin_interfaces/msg/Time"
BYTES = "std_msgs/msg/UInt8MultiArray"

DISPLACEMENT = Topic("/pea/displacement", JOINT_STATE, WINDOW + 48, "plant", ("observer",))
STATE = Topic("/pea/state", JOINT_STATE, WINDOW + 48, "observer", ("controller",))
VOLTAGE = Topic("/pea/voltage", JOINT_STATE, WINDOW + 48, "controller", ("plant",))
REFERENCE = Topic("/pea/reference", JOINT_TRAJECTORY, 16, "reference", ("controller",))

FOLLOWED = Topic("/pea/followed", JOINT_TRAJECTORY, 64, "controller", (), latched=True)
"""The reference as the controller has accepted it. Plant, recorder and dashboard listen here. So a
subscriber of `REFERENCE` is the controller, and all of a reference may be sent once, to the first.
"""

CONSUMED = Topic("/pea/consumed", TIME, 1, "controller", (), latched=True)
"""Stamp up to which the controller has used the reference: the reference keeps ahead of it."""

RECORDED = Topic("/pea/recorded", TIME, 1, RECORDER, ("plant",), latched=True)
"""Stamp up to which every sample is recorded: the plant stays within `WINDOW` of it."""

EVENTS = Topic("/pea/events", "std_msgs/msg/Int64MultiArray", 256, "reference", ())
"""Frames, lines, pixels and points of a scan as they begin, see `pea_wire.scanning`."""

SIGNAL = Topic("/pea/signal", JOINT_STATE, WINDOW + 48, "plant", ())
"""The sample signal at each sample, `pea_core.signals.SIGNAL`, where the plant has one."""

DIAGNOSTICS = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", 10, "", ())
PARAMETER_EVENTS = Topic("/parameter_events", "rcl_interfaces/msg/ParameterEvent", 1000, "", ())

SAYS = {"plant": DISPLACEMENT, "observer": STATE, "controller": VOLTAGE, "reference": REFERENCE}
"""What each node says: who says it is that node, whatever its name."""

SAMPLED = (DISPLACEMENT, STATE, VOLTAGE)
"""Topics with one message a sample."""

LOOP = (*SAMPLED, REFERENCE)
"""Topics that a sample is made of: `pea_core.signals.COLUMNS` says what each carries."""


TABLE = tuple(topic for topic in tuple(vars().values()) if isinstance(topic, Topic))
"""Every topic above: the policy of access and the docs follow it."""

BLOCKS = "/blocks"


def blocks_of(topic: Topic) -> Topic:
    """The topic on which the messages of one of `SAMPLED` come again, many at a time."""
    return Topic(f"{topic.name}{BLOCKS}", BYTES, topic.depth, topic.publisher, ())


OWNED = (
    DISPLACEMENT,
    STATE,
    VOLTAGE,
    REFERENCE,
    FOLLOWED,
    CONSUMED,
    RECORDED,
    *(blocks_of(topic) for topic in SAMPLED),
)
"""Topics of the loop: one node publishes each."""

RECORDED_TOPICS = (
    DISPLACEMENT,
    STATE,
    VOLTAGE,
    REFERENCE,
    DIAGNOSTICS,
    PARAMETER_EVENTS,
    EVENTS,
    SIGNAL,
)
"""Topics of a recording; a new one stands last, so that the others keep their channels."""

BESIDE = tuple(topic for topic in RECORDED_TOPICS if topic not in (*LOOP, EVENTS))
"""Topics that the recorder takes down beside the loop's; it computes the events of a scan."""
