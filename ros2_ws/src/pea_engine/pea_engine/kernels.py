"""Kernels: loops over samples, compiled from the text of the models that take part.

A model's functions take and give numbers, NamedTuples and arrays, so numba compiles them
unchanged; nothing is written twice. A combination of models is compiled once and kept on disk,
under a digest of every source that takes part. The results are the same to the bit.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from pea_core import axes, step
from pea_core.axes import (
    rows_of,
)
from pea_core.block import Model
from pea_engine import pace
from pea_engine.kernel import Kernel, compile_kernel, open_sources

EVERY = -1
"""Mask of an array that is no ring: row k is row k."""


def loop_tick(plant: Model, observer: Model, controller: Model) -> Callable[..., Any]:
    """Make the tick of `Loop` for three models: the one that every kernel of a loop calls.

    It reads sample k of the reference in row k & mask of `points`, and writes row r of `rows`.
    """
    compute, commit = step.loop_step(plant, observer, controller)
    layout = rows_of(getattr(controller, "axes", 1))
    reference, previewed = layout.reference, layout.previewed
    finite, write = layout.finite, layout.pack

    def tick(
        points: np.ndarray,
        k: int,
        mask: int,
        ahead: Any,
        theta: Any,
        T_s: float,
        noise: Any,
        p: object,
        s_p: object,
        o: object,
        s_o: object,
        c: object,
        s_c: object,
        rows: np.ndarray,
        r: int,
    ) -> Any:
        W = reference(points, k & mask)
        W_ff = previewed(points, k, mask, ahead, theta, T_s)
        blocks, states = (p, o, c), (s_p, s_o, s_c)
        measured, estimate, u = compute(blocks, states, noise, W, W_ff)
        fine = finite(u)
        if fine:
            s_p, s_o, s_c = commit(blocks, states, noise, W, W_ff, measured, estimate, u)
            write(rows, r, W, measured, estimate, u)
        return fine, u, s_p, s_o, s_c

    return tick


def loop_kernel(plant: Model, observer: Model, controller: Model) -> Kernel:
    """Compile the tick of `Loop` for three models, over an array of samples."""
    tick = loop_tick(plant, observer, controller)
    noise_of = rows_of(getattr(controller, "axes", 1)).noise
    sources = open_sources(tick, noise_of)

    def kernel(
        points: np.ndarray,
        ahead: Any,
        theta: Any,
        T_s: float,
        noise: np.ndarray,
        p: object,
        s_p: object,
        o: object,
        s_o: object,
        c: object,
        s_c: object,
        rows: np.ndarray,
        u: Any,
    ) -> Any:
        sources  # noqa: B018  part of the key under which the result is kept
        n = len(noise)
        for i in range(n):
            fine, u, s_p, s_o, s_c = tick(
                points, i, EVERY, ahead, theta, T_s, noise_of(noise, i),
                p, s_p, o, s_o, c, s_c, rows, i,
            )  # fmt: skip
            if not fine:
                return i, u, s_p, s_o, s_c
        return n, u, s_p, s_o, s_c

    return compile_kernel(kernel)


HEAD, TAKEN, FED, LEAVE = range(4)
"""Cells that `wall_kernel` shares: samples done, samples taken out of the ring, samples that
reference and noise are there for, and whether it shall return."""

BEGUN, DONE = range(2)
"""Columns of `times`: when a sample has begun and ended (ns after its deadline)."""

ENDED, LEFT, STARVED, FULL, UNSAFE, HALTED = range(6)
"""Why `wall_kernel` has returned: no more samples, told to, no reference, nobody has taken the
samples out, a command that is no number, a plant that cannot go on."""


def aim(p: Any, s: Any, W: Any) -> None:
    """Show a plant the reference of the sample that comes."""


def halted(p: Any, s: Any) -> bool:
    """Whether a plant cannot go on, and this sample does not count."""
    return False


def timed(p: Any, s: Any, due: int, begun: int) -> tuple[int, int]:
    """When a sample was due and has begun (ns): a device that sets the pace knows better."""
    return due, begun


def wall_kernel(
    plant: Model, observer: Model, controller: Model, compiled: bool = True
) -> Callable[..., Any]:
    """Compile the tick of `Loop` for three models, one sample each T_s of wall time.

    Everything comes and goes through rings whose length is a power of two; sample k is in row
    k modulo the length. `times` gets, for each sample, how long after its deadline it has begun
    and ended (ns). A late sample is computed at once; none is left out. The model of a plant that
    is a device has an `aim`, a `halted` and a `timed` of its own.
    """
    tick = loop_tick(plant, observer, controller)
    layout = rows_of(getattr(controller, "axes", 1))
    reference, noise_of = layout.reference, layout.noise
    p_aim, p_halted = getattr(plant, "aim", aim), getattr(plant, "halted", halted)
    p_timed = getattr(plant, "timed", timed)
    sources = ""
    if compiled:
        pace.native()
        calls = reference, noise_of, pace.wait_until, p_aim, p_halted, p_timed
        sources = open_sources(tick, *calls)

    def kernel(
        cells: np.ndarray,
        t_0: int,
        T_ns: int,
        spin: int,
        k: int,
        end: int,
        points: np.ndarray,
        ahead: Any,
        theta: Any,
        T_s: float,
        noise: np.ndarray,
        p: object,
        s_p: object,
        o: object,
        s_o: object,
        c: object,
        s_c: object,
        rows: np.ndarray,
        times: np.ndarray,
        u: Any,
    ) -> Any:
        sources  # noqa: B018
        mask, far = len(rows) - 1, len(points) - 1
        why = ENDED
        while k < end:
            due = t_0 + k * T_ns
            begun = pace.wait_until(due, spin)
            if pace.look(cells, LEAVE) != 0:
                why = LEFT
                break
            if k >= pace.look(cells, FED):
                why = STARVED
                break
            if k - pace.look(cells, TAKEN) > mask:
                why = FULL
                break
            r = k & mask
            p_aim(p, s_p, reference(points, k & far))
            fine, u, s_p, s_o, s_c = tick(
                points, k, far, ahead, theta, T_s, noise_of(noise, r),
                p, s_p, o, s_o, c, s_c, rows, r,
            )  # fmt: skip
            if p_halted(p, s_p):
                why = HALTED
                break
            if not fine:
                why = UNSAFE
                break
            due, begun = p_timed(p, s_p, due, begun)
            times[r, BEGUN] = begun - due
            times[r, DONE] = pace.now() - due
            k += 1
            pace.tell(cells, HEAD, k)
        return why, k, u, s_p, s_o, s_c

    return compile_kernel(kernel) if compiled else kernel


def observer_follow_kernel(observer: Model, compiled: bool = True) -> Callable[..., Any]:
    """Compile an observer that runs beside the loop, over samples of its ring."""
    follow, measurement_of = step.step_of(observer).both, axes.ONE.measurement
    sources = open_sources(follow, measurement_of) if compiled else ""

    def kernel(
        k: int,
        end: int,
        points: np.ndarray,
        preview: float,
        T_s: float,
        rows: np.ndarray,
        c: object,
        s: object,
    ) -> Any:
        sources  # noqa: B018
        mask = len(rows) - 1
        for i in range(k, end):
            _, s = follow(c, s, (measurement_of(rows[i & mask]),))
        return s

    return compile_kernel(kernel) if compiled else kernel


def law_follow_kernel(law: Model, compiled: bool = True) -> Callable[..., Any]:
    """Compile a law that runs beside the loop, told the commands of the one that acts."""
    commit = step.step_of(law).commit
    _, reference_of, previewed, _, estimate_of, command_of = axes.ONE[:6]
    sources = ""
    if compiled:
        sources = open_sources(commit, previewed, reference_of, estimate_of, command_of)

    def kernel(
        k: int,
        end: int,
        points: np.ndarray,
        preview: float,
        T_s: float,
        rows: np.ndarray,
        c: object,
        s: object,
    ) -> Any:
        sources  # noqa: B018
        mask, far = len(rows) - 1, len(points) - 1
        ahead = int(preview)
        for i in range(k, end):
            r = i & mask
            W_ff = previewed(points, i, far, ahead, preview - ahead, T_s)
            signals = reference_of(rows, r), W_ff, estimate_of(rows[r])
            s = commit(c, s, signals, command_of(rows[r]), ())
        return s

    return compile_kernel(kernel) if compiled else kernel


def observer_kernel(observer: Model) -> Callable[..., Any]:
    """Compile an observer alone, over rows of recorded samples; it writes its estimates there."""
    both = step.step_of(observer).both
    measurement_of, pack_estimate = axes.ONE.measurement, axes.ONE.pack_estimate
    sources = open_sources(both, measurement_of, pack_estimate)

    def kernel(rows: np.ndarray, c: object, s: object) -> Any:
        sources  # noqa: B018
        for row in rows:
            estimate, s = both(c, s, (measurement_of(row),))
            pack_estimate(row, estimate)
        return s

    return compile_kernel(kernel)


def law_kernel(law: Model) -> Callable[..., Any]:
    """Compile a law alone, over rows of recorded samples; it writes its commands there.

    `points` is the reference from the first row on, as far as the preview reaches.
    """
    both = step.step_of(law).both
    _, reference_of, previewed, _, estimate_of = axes.ONE[:5]
    pack_command = axes.ONE.pack_command
    sources = open_sources(both, previewed, reference_of, estimate_of, pack_command)

    def kernel(
        rows: np.ndarray, points: np.ndarray, preview: float, T_s: float, c: object, s: object
    ) -> Any:
        sources  # noqa: B018
        ahead = int(preview)
        for i in range(len(rows)):
            W = reference_of(rows, i)
            W_ff = previewed(points, i, EVERY, ahead, preview - ahead, T_s)
            u, s = both(c, s, (W, W_ff, estimate_of(rows[i])))
            pack_command(rows[i], u)
        return s

    return compile_kernel(kernel)


def empty_kernel(compiled: bool = True) -> Callable[..., Any]:
    """Compile a loop that keeps time and does nothing else: what the machine itself can hold."""
    sources = ""
    if compiled:
        pace.native()
        sources = open_sources(pace.wait_until)

    def kernel(t_0: int, T_ns: int, spin: int, times: np.ndarray) -> None:
        sources  # noqa: B018
        for k in range(len(times)):
            due = t_0 + k * T_ns
            times[k, BEGUN] = pace.wait_until(due, spin) - due
            times[k, DONE] = pace.now() - due

    return compile_kernel(kernel) if compiled else kernel


def reference_kernel(reference: Model) -> Callable[..., Any]:
    """Compile a reference model over a range of samples."""
    output = reference.output
    pack_reference = rows_of(getattr(reference, "axes", 1)).pack_reference
    sources = open_sources(output, pack_reference)

    def kernel(c: object, k: int, points: np.ndarray) -> None:
        sources  # noqa: B018
        for i in range(len(points)):
            pack_reference(points, i, output(c, k + i))

    return compile_kernel(kernel)


DRIVEN = ("y", "x1", "x2", "x2_dot")
"""Columns that `drive_kernel` writes."""

_Y, _X1, _X2, _X2_DOT = range(len(DRIVEN))


def pack_driven(rows: np.ndarray, i: int, measured: Any, true: Any) -> None:
    """Write what a driven plant says into row i of an array (n, `DRIVEN`)."""
    rows[i, _Y], rows[i, _X1], rows[i, _X2] = measured.y, true.x1, true.x2
    rows[i, _X2_DOT] = true.x2_dot


@cache
def _driven_rows(count: int) -> tuple[Any, Any]:
    """How commands are read from, and what a driven plant says is written to, rows of all axes."""
    if count == 1:
        return axes.noise_of, pack_driven
    width = len(DRIVEN)
    columns = tuple(range(0, width * count, width))
    ends = tuple(first + width for first in columns)
    body = "one(rows[:, a_@:b_@], i, measured[@], true[@])"
    pack = axes.each_axis(
        count, "rows, i, measured, true", body, "{}", "; ", one=pack_driven, a=columns, b=ends
    )
    return rows_of(count).noise, pack


def drive_kernel(plant: Model) -> Callable[..., Any]:
    """Compile a plant model driven by recorded commands; it writes `DRIVEN`, of each axis."""
    compute, commit, _ = step.step_of(plant)
    truth = plant.truth
    row_of, write = _driven_rows(getattr(plant, "axes", 1))
    sources = open_sources(compute, commit, truth, row_of, write)

    def kernel(p: object, s: object, noise: np.ndarray, u: np.ndarray, rows: np.ndarray) -> Any:
        sources  # noqa: B018
        for i in range(len(u)):
            now = row_of(noise, i)
            measured = compute(p, s, (now,))
            write(rows, i, measured, truth(p, s))
            s = commit(p, s, (now,), measured, (row_of(u, i),))
        return s

    return compile_kernel(kernel)
