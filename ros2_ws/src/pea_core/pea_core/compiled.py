"""The loop as one compiled function, made from the models' own text.

A model's functions take and give numbers, NamedTuples and arrays, so numba compiles them
unchanged; nothing is written twice. A combination of models is compiled once and kept on disk,
under a digest of every source that takes part. The results are the same to the bit.
"""

from __future__ import annotations

import hashlib
import importlib.util
import math
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np

from pea_core.block import Block, Signal
from pea_core.loop import PREVIEW_MAX, Loop, LoopFault
from pea_core.signals import SAMPLE, Estimate, Measurement, Reference, between

WORTH = 20_000
"""Samples from which on compiling is worth the wait."""

SWITCH = "PEA_COMPILE"
"""Environment variable: 0 never compiles, 1 always does; unset, long runs are compiled."""


def wanted(samples: int) -> bool:
    """Whether a run of so many samples is to be compiled."""
    switch = os.environ.get(SWITCH, "")
    if switch == "0" or (switch != "1" and samples < WORTH):
        return False
    return importlib.util.find_spec("numba") is not None


def reach(function: FunctionType, found: dict[FunctionType, None]) -> None:
    """Collect every Python function that `function` can call, itself included."""
    if function in found:
        return
    found[function] = None
    enclosed = [cell.cell_contents for cell in function.__closure__ or ()]
    named = [function.__globals__.get(name) for name in function.__code__.co_names]
    for inner in enclosed + named:
        if isinstance(inner, FunctionType):
            reach(inner, found)


@cache
def _source(path: str) -> bytes:
    return Path(path).read_bytes()


def _open(*functions: Callable[..., Any]) -> str:
    """Let compiled code call `functions`; return a digest of their sources."""
    from numba.extending import register_jitable

    found: dict[FunctionType, None] = {}
    for function in functions:
        assert isinstance(function, FunctionType)
        reach(function, found)
    for function in found:
        if function not in _opened:
            _opened.add(function)
            register_jitable(function)
    paths = sorted({function.__code__.co_filename for function in found})
    return hashlib.sha256(b"".join(map(_source, paths))).hexdigest()


_opened: set[FunctionType] = set()


def _compile(function: Callable[..., Any]) -> Callable[..., Any]:
    import numba

    compiled: Callable[..., Any] = numba.njit(function, nogil=True, cache=True)
    return compiled


def loop_kernel(plant: Any, observer: Any, controller: Any) -> Callable[..., Any]:
    """Compile the tick of `Loop` for three models, over an array of samples."""
    p_output, p_update = plant.output, plant.update
    o_output, o_update = observer.output, observer.update
    c_output, c_update = controller.output, controller.update
    sources = _open(p_output, p_update, o_output, o_update, c_output, c_update, between)

    def kernel(
        points: np.ndarray,
        ahead: int,
        theta: float,
        T_s: float,
        noise: np.ndarray,
        p: Any,
        s_p: Any,
        o: Any,
        s_o: Any,
        c: Any,
        s_c: Any,
        rows: np.ndarray,
    ) -> Any:
        sources  # noqa: B018  part of the key under which the result is kept
        n = noise.size
        for i in range(n):
            W = Reference(points[i, 0], points[i, 1], points[i, 2])
            j = i + ahead
            W_ff = Reference(points[j, 0], points[j, 1], points[j, 2])
            if theta != 0.0:
                after = Reference(points[j + 1, 0], points[j + 1, 1], points[j + 1, 2])
                W_ff = between(W_ff, after, theta, T_s)
            measured = p_output(p, s_p, noise[i])
            estimate = o_output(o, s_o, measured)
            u = c_output(c, s_c, W, W_ff, estimate)
            if not math.isfinite(u):
                return i, u, s_p, s_o, s_c
            s_p = p_update(p, s_p, noise[i], measured, u)
            s_o = o_update(o, s_o, measured, estimate)
            s_c = c_update(c, s_c, W, W_ff, estimate, u)
            rows[i, 0] = W.w
            rows[i, 1] = W.w_dot
            rows[i, 2] = W.w_ddot
            rows[i, 3] = measured.y
            rows[i, 4] = measured.y_dot
            rows[i, 5] = measured.u_applied
            rows[i, 6] = estimate.x1
            rows[i, 7] = estimate.x2
            rows[i, 8] = estimate.eps
            rows[i, 9] = u
        return n, 0.0, s_p, s_o, s_c

    return _compile(kernel)


def reference_kernel(reference: Any) -> Callable[..., Any]:
    """Compile a reference model over a range of samples."""
    output = reference.output
    sources = _open(output)

    def kernel(c: Any, k: int, points: np.ndarray) -> None:
        sources  # noqa: B018
        for i in range(len(points)):
            W = output(c, k + i)
            points[i, 0] = W.w
            points[i, 1] = W.w_dot
            points[i, 2] = W.w_ddot

    return _compile(kernel)


def drive_kernel(plant: Any) -> Callable[..., Any]:
    """Compile a plant model driven by recorded commands."""
    output, update, truth = plant.output, plant.update, plant.truth
    sources = _open(output, update, truth)

    def kernel(p: Any, s: Any, noise: np.ndarray, u: np.ndarray, rows: np.ndarray) -> Any:
        sources  # noqa: B018
        for i in range(u.size):
            measured = output(p, s, noise[i])
            true = truth(p, s)
            rows[i, 0] = measured.y
            rows[i, 1] = true.x1
            rows[i, 2] = true.x2
            rows[i, 3] = true.x2_dot
            s = update(p, s, noise[i], measured, u[i])
        return s

    return _compile(kernel)


class CompiledLoop(Loop):
    """`Loop` with a simulated plant, compiled.

    Parameters
    ----------
    plant : Block
        Simulated plant with ``noise(n)``.
    observer, controller : Block
        Estimator and control law.
    reference : Signal
        Desired displacement.
    T_s : float
        Sample period (s).
    """

    def __init__(
        self, plant: Any, observer: Block, controller: Block, reference: Signal, T_s: float
    ) -> None:
        super().__init__(plant, observer, controller, reference, T_s)
        self._points = reference_kernel(reference.model)
        self._kernel = loop_kernel(plant.model, observer.model, controller.model)

    def run(self, samples: int) -> np.ndarray:
        """Go on for some samples; fewer are returned where the loop cannot go on (`fault`)."""
        plant: Any = self.plant
        points = np.empty((samples + PREVIEW_MAX + 1, 3))
        self._points(self.reference.c, self.k, points)
        preview = self.controller.params.preview
        ahead = int(preview)
        rows = np.empty((samples, len(SAMPLE.names or ())))
        done, u, plant.s, self.observer.s, self.controller.s = self._kernel(
            points,
            ahead,
            preview - ahead,
            self.horizon.T_s,
            plant.noise(samples),
            plant.c,
            plant.s,
            self.observer.c,
            self.observer.s,
            self.controller.c,
            self.controller.s,
            rows,
        )
        if done:
            self._remember(rows[done - 1], points, done - 1 + ahead, preview - ahead)
        self.k += done
        if done < samples:
            self.fault = LoopFault(
                f"voltage at sample {self.k} is {u}: a command must be a finite number"
            )
        return rows[:done].reshape(-1).view(SAMPLE)

    def _remember(self, row: np.ndarray, points: np.ndarray, j: int, theta: float) -> None:
        """Leave in the controller what `Block.retune` asks for: the last sample's signals."""
        W, measured, estimate = Reference(*row[:3]), Measurement(*row[3:6]), Estimate(*row[6:9])
        W_ff = Reference(*points[j])
        if theta != 0.0:
            W_ff = between(W_ff, Reference(*points[j + 1]), theta, self.horizon.T_s)
        self.observer.signals, self.observer.out = (measured,), estimate
        self.controller.signals, self.controller.out = (W, W_ff, estimate), float(row[9])
