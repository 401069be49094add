"""What a loop in one process shows of itself on its topics, a frame at a time.

Decimated
    On the topics themselves: of each frame the samples at which y, y - w, u or eps_hat is
    smallest or largest, with their true stamps, the same ones on all four; of the sample signal,
    where there is one, the same samples.
Full rate
    On ``<topic>/blocks``, while somebody subscribes: every sample, many in one message.
"""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np

from pea_core.axes import one_axis
from pea_core.config import AXIS
from pea_core.signals import columns_of
from pea_record.rows import NO_SIGNAL, Events
from pea_report.decimation import extremes
from pea_ros.transport import Outbox
from pea_wire import convert, scanning
from pea_wire.topics import EVENTS, LOOP, REFERENCE, SIGNAL, WINDOW, Topic, blocks_of

FRAME = 0.04
"""Seconds of a frame."""

KEPT = 64
"""Blocks kept for a subscriber that lags."""


class Telemetry:
    """Publishes samples of a loop.

    Parameters
    ----------
    nodes : mapping of str to rclpy.node.Node
        By name of the block.
    T_ns : int
        Sample period (ns).
    axes : tuple of str
        Names of the axes.
    scanned : callable, optional
        Events of the scan that begin at samples first to last - 1.
    """

    def __init__(
        self,
        nodes: Mapping[str, object],
        T_ns: int,
        axes: tuple[str, ...] = (AXIS,),
        scanned: Events | None = None,
    ) -> None:
        self.scanned = scanned
        self.events = Outbox(nodes["reference"], EVENTS) if scanned is not None else None
        self.T_ns = T_ns
        self.forms = convert.forms(axes)
        self._plant = nodes[SIGNAL.publisher]
        self._signal: Outbox | None = None  # from the first that is known
        self._rows: list[np.ndarray] = []
        self._told: list[np.ndarray] = []
        self._k = 0
        self._due = 0.0
        self._topics: dict[Topic, tuple[Outbox, Outbox]] = {}
        for topic in LOOP:
            node = nodes[topic.publisher]
            blocks = blocks_of(topic)._replace(depth=KEPT)
            self._topics[topic] = Outbox(node, blocks), Outbox(node, topic)

    def add(
        self, k: int, rows: np.ndarray, last: bool = False, signal: np.ndarray = NO_SIGNAL
    ) -> None:
        """Take samples k, k+1, ...; publish when a frame is full, or with the last ones.

        Parameters
        ----------
        k : int
            Number of the first of `rows`; it follows those of before.
        rows : (n,) or (n, axes) array of `SAMPLE`
        last : bool
            Whether no more will come.
        signal : (n,) array
            The sample signal at each, NaN where it is not known; empty where nothing tells it.
        """
        if len(rows):
            self._k = self._k if self._rows else k
            self._rows.append(rows)
            self._told.append(signal)
        now = time.monotonic()
        if self._rows and (last or now >= self._due):
            self._due = max(self._due + FRAME, now)  # 25 a second, however late each is asked for
            rows, signal = np.concatenate(self._rows), np.concatenate(self._told)
            self._rows.clear()
            self._told.clear()
            self._publish(self._k, rows, signal)

    def _publish(self, k: int, rows: np.ndarray, signal: np.ndarray) -> None:
        """Publish a frame that begins with sample k."""
        if self.scanned is not None and self.events is not None:
            found = self.scanned(k, k + len(rows))
            if len(found):
                self.events.send(scanning.encode(found, self.T_ns))
        stamps = (k + np.arange(len(rows), dtype=np.int64)) * self.T_ns
        own = [one_axis(rows, i) for i in range(len(self.forms.axes))]
        signals = [x for r in own for x in (r["y"], r["y"] - r["w"], r["u"], r["eps_hat"])]
        shown = extremes(signals, len(rows))
        for topic, (blocks, outbox) in self._topics.items():
            if blocks.subscribers:
                for start in range(0, len(rows), WINDOW):
                    part = slice(start, start + WINDOW)
                    messages = self._messages(topic, stamps[part], rows[part])
                    blocks.send(convert.encode_block(messages.itemsize, messages.tobytes()))
            for message in self._messages(topic, stamps[shown], rows[shown]):
                outbox.send(message.tobytes())
        if len(signal) == len(rows):
            known = shown[np.isfinite(signal[shown])]
            self._detected(stamps[known], signal[known])

    def _detected(self, stamps: np.ndarray, signal: np.ndarray) -> None:
        """Publish the sample signal."""
        if self._signal is None and len(signal):
            self._signal = Outbox(self._plant, SIGNAL)
        if self._signal is not None:
            for message in convert.DETECTED.encode_many(stamps, signal):
                self._signal.send(message.tobytes())

    def _messages(self, topic: Topic, stamps: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """CDR of a topic's messages: one a row."""
        if topic == REFERENCE:
            columns = columns_of(topic.relative)
            return self.forms.reference.encode_each(stamps, *(rows[c.name] for c in columns))
        return self.forms.messages(topic, stamps, rows)
