"""One sample of a node compiled: a message in, a step of the block, a message out.

What is not the plain next sample (another layout, another stamp, a command that is no number) is
left untouched: the node handles that one message in Python, then comes back.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from pea_core.axes import each_axis, rows_of
from pea_core.block import Model
from pea_core.signals import Estimate, Measurement, Reference
from pea_core.step import step_of
from pea_core.units import SECOND
from pea_engine.compiled import no_command
from pea_engine.kernel import open_sources
from pea_wire.convert import JointStateCodec

_FIELDS = ("position", "velocity", "effort")


class FixedMessage(NamedTuple):
    """A message of fixed layout in memory: its constant part and where its numbers are.

    Attributes
    ----------
    bytes, doubles, words : arrays on the same memory
        As uint8; as float64 and uint32 from behind the encapsulation on, where CDR counts from.
    template : (size,) array of uint8
    constant : array of int64
        Places of the bytes that are always the same.
    at : (3,) array of int64
        Places of position, velocity and effort among `doubles`; -1 where they are left out.
    """

    bytes: np.ndarray
    doubles: np.ndarray
    words: np.ndarray
    template: np.ndarray
    constant: np.ndarray
    at: np.ndarray

    @classmethod
    def of(cls, codec: JointStateCodec) -> FixedMessage:
        """Room for one message of `codec`, filled with what is constant."""
        fields: Any = codec.dtype.fields or {}
        room = np.zeros(codec.size + 24, np.uint8)
        lead = -(room.ctypes.data + 4) % 8
        whole = room[lead : lead + codec.size]
        nothing = no_command(len(codec.axes))
        message = codec.encode(0, *[nothing] * sum(codec.carries))
        template = np.frombuffer(message, np.uint8).copy()
        whole[:] = template
        varies = np.zeros(codec.size, bool)
        varies[4:12] = True
        at = np.full(3, -1)
        for i, field in enumerate(_FIELDS):
            if field in fields:
                place = int(fields[field][1])
                varies[place : place + fields[field][0].itemsize] = True
                at[i] = (place - 4) // 8
            if f"pad_{field}" in fields:
                kind, place = fields[f"pad_{field}"][:2]
                varies[place : place + kind.itemsize] = True
        body = room[lead + 4 : lead + 4 + (codec.size - 4) // 8 * 8]
        return cls(
            whole,
            body.view(np.float64),
            body.view(np.uint32),
            template,
            np.flatnonzero(~varies),
            at,
        )


def _number_at(doubles: np.ndarray, a: int) -> float:
    """A number of a message; NaN where it is left out."""
    return doubles[a] if a >= 0 else math.nan


def _number_to(doubles: np.ndarray, a: int, value: float) -> None:
    """Write a number of a message."""
    doubles[a] = value


@cache
def numbers_at(axes: int) -> Any:
    """The function that reads a field of a message: one number, or one of each axis."""
    if axes == 1:
        return _number_at
    body = "doubles[a + @] if a >= 0 else nan"
    return each_axis(axes, "doubles, a", body, nan=math.nan)


@cache
def numbers_to(axes: int) -> Any:
    """The function that writes a field of a message."""
    if axes == 1:
        return _number_to
    return each_axis(axes, "doubles, a, value", "doubles[a + @] = value[@]", "{}", "; ")


@cache
def signal_of(axes: int, kind: Any) -> Any:
    """The function that makes a signal from its three fields."""
    if axes == 1:
        return each_axis(1, "a, b, d", "kind(a, b, d)", "return {}", kind=kind)
    return each_axis(axes, "a, b, d", "kind(a[@], b[@], d[@])", kind=kind)


@cache
def signal_fields(axes: int, *names: str) -> Any:
    """The function that takes a signal apart into three fields, see `signal_of`."""
    if axes == 1:
        own = ", ".join(f"signal.{name}" for name in names)
    else:
        columns = (", ".join(f"signal[{i}].{name}" for i in range(axes)) for name in names)
        own = ", ".join(f"({column},)" for column in columns)
    return each_axis(1, "signal", own, "return {}")


def answering(head: Callable[..., Any], lead: int, axes: int = 1) -> tuple[Callable[..., Any], str]:
    """Make the function that answers a message, and a digest of the sources it is made from.

    Parameters
    ----------
    head : callable
        ``head(c, s, m, extra, k, position, velocity, effort) -> fine, s, m, position, velocity,
        effort``: what to send for sample k. Where it is not fine, nothing may have changed.
    lead : int
        Samples by which the message sent is ahead of the one taken.
    axes : int
        Number of axes.

    Returns
    -------
    callable
        ``answer(k, T_ns, taken, sent, c, s, m, extra) -> fine, s, m``: reads the message in the
        frame `taken`, writes the one in `sent`.
    str
        The digest: part of the key under which a kernel is kept.
    """
    numbers, put = numbers_at(axes), numbers_to(axes)

    def answer(
        k: int,
        T_ns: int,
        taken: FixedMessage,
        sent: FixedMessage,
        c: Any,
        s: Any,
        m: Any,
        extra: Any,
    ) -> Any:
        for i in taken.constant:
            if taken.bytes[i] != taken.template[i]:
                return False, s, m
        stamp = np.int64(taken.words[0]) * SECOND + np.int64(taken.words[1])
        if stamp != k * T_ns:
            return False, s, m
        a, b, d = taken.at
        fine, s, m, position, velocity, effort = head(
            c,
            s,
            m,
            extra,
            k,
            numbers(taken.doubles, a),
            numbers(taken.doubles, b),
            numbers(taken.doubles, d),
        )
        if not fine:
            return False, s, m
        due = (k + lead) * T_ns
        sent.words[0] = due // SECOND
        sent.words[1] = due % SECOND
        a, b, d = sent.at
        if a >= 0:
            put(sent.doubles, a, position)
        if b >= 0:
            put(sent.doubles, b, velocity)
        if d >= 0:
            put(sent.doubles, d, effort)
        return True, s, m

    return answer, open_sources(head, answer)


# Each role's part: what its head, its tail and its lead are, and an `m` before the first sample.


def blank(kind: Any, axes: int) -> Any:
    """A signal of zeros; of each axis where there are several."""
    none = kind(*[0.0] * len(kind._fields))
    return none if axes == 1 else (none,) * axes


def plant_hop(model: Model) -> Any:
    """Parts of a simulated plant's hop; `extra` is the noise from sample k_0 on, and k_0."""
    compute, commit, _ = step_of(model)
    axes = getattr(model, "axes", 1)
    finite, noise_of = rows_of(axes).finite, rows_of(axes).noise
    fields_of = signal_fields(axes, "y", "y_dot", "u_applied")

    def head(
        c: Any, s: Any, m: Any, extra: Any, k: int, position: Any, velocity: Any, effort: Any
    ) -> Any:
        signals, measured = m
        fine = finite(effort)
        if fine:
            s = commit(c, s, signals, measured, (effort,))
            signals = (noise_of(extra[0], k + 1 - extra[1]),)
            measured = compute(c, s, signals)
        y, y_dot, u_applied = fields_of(measured)
        return fine, s, (signals, measured), y, y_dot, u_applied

    def tail(c: object, s: object, m: object) -> Any:
        return s

    return head, tail, 1, ((no_command(axes),), blank(Measurement, axes))


def observer_hop(model: Model) -> Any:
    """Parts of an observer's hop; there is nothing `extra`."""
    compute, commit, _ = step_of(model)
    axes = getattr(model, "axes", 1)
    finite, measurement = rows_of(axes).finite, signal_of(axes, Measurement)
    fields_of = signal_fields(axes, "x1", "x2", "eps")

    def head(
        c: Any,
        s: Any,
        m: Any,
        extra: Any,
        k: int,
        position: Any,
        velocity: Any,
        effort: Any,
    ) -> Any:
        signals, estimate = m
        fine = finite(position) and finite(effort)
        if fine:
            signals = (measurement(position, velocity, effort),)
            estimate = compute(c, s, signals)
        x1, x2, eps = fields_of(estimate)
        return fine, s, (signals, estimate), x1, x2, eps

    def tail(c: Any, s: Any, m: Any) -> Any:
        return commit(c, s, m[0], m[1], ())

    return head, tail, 0, ((blank(Measurement, axes),), blank(Estimate, axes))


def controller_hop(model: Model) -> Any:
    """Parts of a law's hop; `extra`: the reference in a ring, the preview in two, T_s."""
    compute, commit, _ = step_of(model)
    axes = getattr(model, "axes", 1)
    layout, estimate = rows_of(axes), signal_of(axes, Estimate)
    finite, reference, previewed = layout.finite, layout.reference, layout.previewed

    def head(
        c: Any, s: Any, m: Any, extra: Any, k: int, position: Any, velocity: Any, effort: Any
    ) -> Any:
        signals, u = m
        fine = finite(position) and finite(velocity) and finite(effort)
        if fine:
            points, ahead, theta, T_s = extra
            mask = len(points) - 1
            W = reference(points, k & mask)
            W_ff = previewed(points, k, mask, ahead, theta, T_s)
            signals = W, W_ff, estimate(position, velocity, effort)
            u = compute(c, s, signals)
        return fine, s, (signals, u), u, u, u

    def tail(c: Any, s: Any, m: Any) -> Any:
        return commit(c, s, m[0], m[1], ())

    W = blank(Reference, axes)
    return head, tail, 0, ((W, W, blank(Estimate, axes)), no_command(axes))


class Hop:
    """The compiled hot path of a node, between its inbox and its outbox.

    Parameters
    ----------
    T_ns : int
        Sample period (ns).
    block : Block
        What is stepped; its state, signals and output are kept up to date.
    make : callable
        `plant_hop`, `observer_hop` or `controller_hop`.
    inbox, outbox : Inbox, SampledOutbox
    takes : tuple of JointStateCodec
        Layouts that may come; the first is expected.
    sends : JointStateCodec
        Layout that is sent.
    extra : Any
        The like of what `run` will get.
    """

    def __init__(
        self,
        T_ns: int,
        block: Any,
        make: Callable[[Any], Any],
        inbox: Any,
        outbox: Any,
        takes: tuple[JointStateCodec, ...],
        sends: JointStateCodec,
        extra: object,
    ) -> None:
        self.block = block
        self.inbox, self.outbox = inbox, outbox
        self.T_ns = T_ns
        self.model = block.model
        self.axes = getattr(block.model, "axes", 1)
        self.head, self.tail, self.lead, self._blank = make(block.model)
        self.frames = {codec.size: FixedMessage.of(codec) for codec in takes}
        self.taken = self.frames[takes[0].size]
        self.sent = FixedMessage.of(sends)
        self.used = False
        self.prepare(extra)

    def prepare(self, extra: object) -> None:
        """Compile, or fetch from disk."""
        raise NotImplementedError

    @property
    def memory(self) -> tuple[Any, Any]:
        """State of the block, and its signals and output."""
        block = self.block
        return block.s, self._blank if block.signals is None else (block.signals, block.out)

    @memory.setter
    def memory(self, memory: tuple[Any, Any]) -> None:
        self.block.s, (self.block.signals, self.block.out) = memory

    def serves(self) -> bool:
        """Whether the block still has the model that was compiled, and is not being changed."""
        return self.block.model is self.model and self.block.coming is None

    def odd(self, data: bytes) -> bytes:
        """Expect the layout of a message that was not the plain next sample, from now on."""
        self.taken = self.frames.get(len(data), self.taken)
        return data

    def run(self, k: int, end: int, until: int, extra: object) -> tuple[int, bytes | None]:
        """Serve samples k to `end`, as they come.

        Parameters
        ----------
        until : int
            Monotonic clock (ns) at which to return at the latest.
        extra : Any
            What the hop's head asks for.

        Returns
        -------
        int
            The next sample.
        bytes or None
            A message that was taken and that Python has to handle.

        Raises
        ------
        RCLError
            librcl refuses.
        """
        raise NotImplementedError
