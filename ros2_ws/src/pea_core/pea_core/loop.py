"""The loop: one tick a sample, every block computes, then every block commits.

Tick k: y_k is measured, then x̂_k, then u_k, applied on [t_k, t_{k+1}). What was really applied
comes back with y_{k+1}.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from pea_core.axes import number_of_axes, preview_of, shape
from pea_core.signals import SAMPLE, Reference, between

PREVIEW_MAX = 64
"""Samples of reference that must be known beyond the current one."""

CHUNK = 1000
"""Samples of reference sent at a time."""


class LoopFault(Exception):
    """The loop cannot go on; the text says at which sample and why."""


class Plant(Protocol):
    """What the loop asks of a plant, simulated or real; of several axes all signals are tuples."""

    def read(self) -> Any:
        """Measure at this sample: a `Measurement`."""

    def write(self, u: Any) -> None:
        """Apply the command u (V) from this sample on."""


class Horizon:
    """The part of the reference that is known: this sample and some way ahead.

    Parameters
    ----------
    T_s : float
        Sample period (s).
    first : int
        The first sample that will be known.
    """

    def __init__(self, T_s: float, first: int = 0) -> None:
        self.T_s = T_s
        self.preview: Any = 0.0
        self._chunks: deque[Sequence[Reference]] = deque()
        self._first = self.end = first

    def extend(self, k: int, points: Sequence[Reference]) -> None:
        """Append the points of samples k, k+1, ...

        Raises
        ------
        LoopFault
            k is not the next sample: something was lost or sent twice.
        """
        if k != self.end:
            raise LoopFault(f"reference: expected sample {self.end}, got {k}")
        self._chunks.append(points)
        self.end += len(points)

    def knows(self, k: int) -> bool:
        """Whether sample k and what a preview may ask for is there."""
        return k + PREVIEW_MAX < self.end

    def forget(self, k: int) -> None:
        """Drop what is before sample k."""
        while self._chunks and k - self._first >= len(self._chunks[0]):
            self._first += len(self._chunks.popleft())

    def _point(self, k: int) -> Reference:
        i = k - self._first
        for points in self._chunks:
            if i < len(points):
                return points[i]
            i -= len(points)
        raise LoopFault(f"reference: sample {k} is not known yet, only up to {self.end - 1}")

    def at(self, k: int) -> tuple[Reference, Reference]:
        """Reference at sample k, and at k + preview; samples before k are forgotten.

        Raises
        ------
        LoopFault
            k is forgotten, or k or what the preview asks for is not known yet.
        """
        if k < self._first:
            raise LoopFault(f"reference: sample {k} is forgotten, the first kept is {self._first}")
        if k >= self.end:
            raise LoopFault(f"reference: sample {k} is not known yet, only up to {self.end - 1}")
        self.forget(k)
        W = self._point(k)
        return W, W if self.preview == 0.0 else self.ahead(k, self.preview)

    def ahead(self, k: int, preview: Any) -> Any:
        """Reference at k + preview; of each axis at its own, where there are several.

        Errors as `at`.
        """
        if isinstance(preview, tuple):
            return tuple(self._ahead(k, own, axis) for axis, own in enumerate(preview))
        return self._ahead(k, preview)

    def _ahead(self, k: int, preview: float, axis: int | None = None) -> Any:
        whole = int(preview)
        theta = preview - whole
        here = self._of(k + whole, axis)
        if theta == 0.0:
            return here
        return between(here, self._of(k + whole + 1, axis), theta, self.T_s)

    def _of(self, k: int, axis: int | None) -> Any:
        """The point of a sample, or what it holds of one axis."""
        point: Any = self._point(k)
        return point if axis is None else point[axis]


def command(controller: Any, horizon: Horizon, k: int, estimate: Any) -> tuple[Any, Any]:
    """Reference and command of sample k; a change of the law that is due takes effect."""
    horizon.preview = preview_of(controller.params)
    W, W_ff = horizon.at(k)
    if controller.coming is not None:
        own = horizon.ahead(k, preview_of(controller.planned))
        controller.foresee(W, own, estimate)
    return W, controller.output(W, W_ff, estimate)


class Loop:
    """Plant, observer, controller and reference, one sample after the other.

    Parameters
    ----------
    plant : Plant
        What is controlled.
    observer, controller : Block or Several
        Estimator and control law.
    reference : Signal or Several
        Desired displacement, a function of the sample number.
    T_s : float
        Sample period (s).

    Attributes
    ----------
    k : int
        Next sample.
    fault : LoopFault or None
        Why the loop could not go on.
    piece : int
        Samples that it is best asked for at a time.
    """

    piece = CHUNK

    def __init__(
        self, plant: Plant, observer: Any, controller: Any, reference: Any, T_s: float
    ) -> None:
        self.plant = plant
        self.observer = observer
        self.controller = controller
        self.reference = reference
        self.axes = number_of_axes(controller)
        self.horizon = Horizon(T_s)
        self.k = 0
        self.fault: LoopFault | None = None

    def foresee(self) -> None:
        """Compute the next chunk of the reference, where it is needed."""
        while not self.horizon.knows(self.k + CHUNK):
            k = self.horizon.end
            self.horizon.extend(k, [self.reference.at(i) for i in range(k, k + CHUNK)])

    def coming(self, k: int) -> Any:
        """Reference of a sample that comes next, as far as known the one that previews saw."""
        return self.horizon.ahead(k, 0.0) if k < self.horizon.end else self.reference.at(k)

    def run(self, samples: int, rows: np.ndarray | None = None) -> np.ndarray:
        """Go on for some samples.

        Parameters
        ----------
        samples : int
            At most `CHUNK`.
        rows : (samples,) array of `SAMPLE`, optional
            Where they are written; else a new array.

        Returns
        -------
        (samples,) array of `SAMPLE`
            What every block said; fewer rows where the loop could not go on (`fault`).

        Raises
        ------
        ValueError
            More samples than `CHUNK`: the reference is not known so far ahead.
        """
        if samples > CHUNK:
            raise ValueError(f"samples = {samples}: at most {CHUNK} at a time, see blocks_of")
        self.foresee()
        if rows is None:
            rows = np.empty(shape(samples, self.axes), SAMPLE)
        horizon, read, write = self.horizon, self.plant.read, self.plant.write
        observer, controller = self.observer, self.controller
        for i in range(samples):
            measured = read()
            estimate = observer.output(measured)
            W, u = command(controller, horizon, self.k, estimate)
            try:
                write(u)
            except LoopFault as fault:
                self.fault = fault
                return rows[:i]
            observer.update()
            controller.update()
            if self.axes == 1:
                rows[i] = (*W, *measured, *estimate, u)
            else:
                own = zip(W, measured, estimate, u, strict=True)
                rows[i] = [(*a, *b, *c, d) for a, b, c, d in own]
            self.k += 1
        return rows


def blocks_of(samples: int, piece: int = CHUNK) -> list[int]:
    """Lengths of the pieces in which a run of `samples` is computed, or recorded."""
    whole, rest = divmod(samples, piece)
    return [piece] * whole + [rest] * (rest > 0)


def trace(rows: Sequence[np.ndarray]) -> Any:
    """The pieces of a run as one array."""
    return np.concatenate(rows) if rows else np.empty(0, SAMPLE)
