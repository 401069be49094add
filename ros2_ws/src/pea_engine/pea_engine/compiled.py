"""The loop run by a compiled kernel, for long runs. Its bits are those of plain Python."""

from __future__ import annotations

import importlib.util
import os
from typing import Any

import numpy as np

from pea_core.axes import (
    POINT,
    each,
    number_of_axes,
    preview_of,
    references_of,
    rows_of,
    shape,
    split,
)
from pea_core.loop import CHUNK, PREVIEW_MAX, Horizon, Loop, LoopFault
from pea_core.params import ParameterError
from pea_core.signals import SAMPLE
from pea_engine.kernels import EVERY, loop_kernel, reference_kernel

WORTH = 20_000
"""Least samples of a run for which compiling saves time."""

SWITCH = "PEA_COMPILE"
"""Environment variable: 0 never compiles, 1 always does; unset, long runs are compiled."""


def wanted(samples: int) -> bool:
    """Whether to compile a run of this many samples.

    Raises
    ------
    ParameterError
        `SWITCH` is set to something else.
    """
    switch = os.environ.get(SWITCH, "")
    if switch not in ("", "0", "1"):
        raise ParameterError(f"{SWITCH} = {switch!r}: give 0 (never) or 1 (always), or unset it")
    if switch == "0" or (switch != "1" and samples < WORTH):
        return False
    return importlib.util.find_spec("numba") is not None


class CompiledLoop(Loop):
    """A compiled `Loop` with a simulated plant.

    Parameters
    ----------
    plant : Block
        Simulated plant with ``noise(n)``.
    observer, controller : Block or Several
        Estimator and control law.
    reference : Signal or Several
        Desired displacement.
    T_s : float
        Sample period (s).
    """

    piece = 8 * CHUNK  # a call costs as much as some hundred samples

    def __init__(
        self, plant: Any, observer: Any, controller: Any, reference: Any, T_s: float
    ) -> None:
        super().__init__(plant, observer, controller, reference, T_s)
        self._points = reference_kernel(reference.model)
        self._models: tuple[Any, ...] = ()
        # points of the reference from sample k on, as far as a preview has read them
        self._seen = np.empty((0, POINT * self.axes))

    def run(self, samples: int, rows: np.ndarray | None = None) -> np.ndarray:
        """Run some samples; return fewer if the loop cannot go on (`fault`).

        While a change of a block takes effect, the loop runs in plain Python.
        """
        if rows is None:
            rows = np.empty(shape(samples, self.axes), SAMPLE)
        done = 0
        while done < samples and self.fault is None:
            if self._changing:
                self.horizon = Horizon(self.horizon.T_s, self.k)
                self.horizon.extend(self.k, references_of(self._seen))
                n = min(samples - done, CHUNK, self._changing)
                done += len(super().run(n, rows[done : done + n]))
                seen = range(self.k, self.k + PREVIEW_MAX)
                known = np.array([self.horizon.ahead(k, 0.0) for k in seen])
                self._seen = known.reshape(len(seen), -1)
            else:
                done += self._run(rows[done:])
        return rows[:done]

    def coming(self, k: int) -> Any:
        """Reference of a future sample; the point that a preview has read, if there is one."""
        i = k - self.k
        if i >= len(self._seen):
            return self.reference.at(k)
        return references_of(self._seen[i : i + 1])[0]

    @property
    def _changing(self) -> int:
        """Samples until a change has taken effect; 0 without a change."""
        blocks = (*each(self.observer), *each(self.controller))
        return min((block.coming.wait + 1 for block in blocks if block.coming), default=0)

    def _run(self, rows: np.ndarray) -> int:
        """Fill `rows`; return the number of samples that were run."""
        samples = len(rows)
        models = (self.plant.model, self.observer.model, self.controller.model)  # type: ignore[attr-defined]
        if models != self._models:
            self._models, self._kernel = models, loop_kernel(*models)
        plant: Any = self.plant
        points = np.empty((samples + PREVIEW_MAX + 1, POINT * self.axes))
        self._points(self.reference.due(self.k + len(self._seen)), self.k, points)
        points[: len(self._seen)] = self._seen
        ahead, theta = split(preview_of(self.controller.params))
        numbers = rows.view(np.float64).reshape(samples, -1)
        done, u, plant.s, self.observer.s, self.controller.s = self._kernel.again(
            points,
            ahead,
            theta,
            self.horizon.T_s,
            plant.noise(samples),
            plant.c,
            plant.s,
            self.observer.c,
            self.observer.s,
            self.controller.c,
            self.controller.s,
            numbers,
            no_command(self.axes),
        )
        if done:
            W_ff = rows_of(self.axes).previewed(
                points, done - 1, EVERY, ahead, theta, self.horizon.T_s
            )
            remember(self.observer, self.controller, numbers[done - 1], W_ff)
        self.k += done
        self._seen = points[done : done + PREVIEW_MAX].copy()
        if done < samples:
            self.fault = LoopFault(
                f"voltage at sample {self.k} is {u}: a command must be a finite number"
            )
        return int(done)


def no_command(axes: int) -> Any:
    """The command 0 V; with several axes, one for each axis."""
    return 0.0 if axes == 1 else (0.0,) * axes


def remember(observer: Any, controller: Any, row: np.ndarray, W_ff: Any) -> None:
    """Store the signals of the last sample in the blocks.

    Parameters
    ----------
    observer, controller : Block or Several
        Blocks of a loop that a kernel has run.
    row : array
        The last sample, as the kernel has written it.
    W_ff : Reference
        The reference previewed at that sample; with several axes, one for each axis.
    """
    layout = rows_of(number_of_axes(controller))
    measured, estimate = layout.measurement(row), layout.estimate(row)
    observer.signals, observer.out = (measured,), estimate
    controller.signals = (layout.reference(row_of_points(row, layout.axes), 0), W_ff, estimate)
    command = layout.command(row)
    controller.out = float(command) if layout.axes == 1 else tuple(map(float, command))


def row_of_points(row: np.ndarray, axes: int) -> np.ndarray:
    """The reference in a row of all signals, as an array (1, axes x 3) of points."""
    return row.reshape(axes, -1)[:, :POINT].reshape(1, -1)
