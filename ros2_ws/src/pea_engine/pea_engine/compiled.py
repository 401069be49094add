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
import pickle
import stat
from collections.abc import Callable
from functools import cache
from itertools import chain
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np

from pea_core import step
from pea_core.block import Block, Model, Signal
from pea_core.interrupt import INTERRUPT
from pea_core.loop import CHUNK, PREVIEW_MAX, Horizon, Loop, LoopFault
from pea_core.params import ParameterError
from pea_core.signals import (
    SAMPLE,
    Reference,
    between,
    command_of,
    estimate_of,
    measurement_of,
    pack,
    pack_command,
    pack_estimate,
    pack_reference,
    reference_of,
)
from pea_engine import pace

WORTH = 20_000
"""Samples from which on compiling is worth the wait."""

SWITCH = "PEA_COMPILE"
"""Environment variable: 0 never compiles, 1 always does; unset, long runs are compiled."""


def wanted(samples: int) -> bool:
    """Whether a run of so many samples is to be compiled.

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


def open_sources(
    *functions: Callable[..., object], inline: Callable[..., object] | None = None
) -> str:
    """Let compiled code call `functions`; return a digest of their sources.

    `inline`, and every step (`pea_core.step`), is written out where it is called: numba counts the
    references to every array that a call hands over, which for all of the coefficients and states
    costs more than the sample.
    """
    from numba.extending import register_jitable

    found: dict[FunctionType, None] = {}
    for function in functions:
        assert isinstance(function, FunctionType)
        reach(function, found)
    written = {f for f in found if f is inline or f.__module__ == step.__name__}
    # what a kernel calls itself, it calls once: laid into it, whatever its size
    cells = chain(*(function.__closure__ or () for function in written))
    direct = {*functions, *(cell.cell_contents for cell in cells)}
    for function in found:
        if function not in _opened:
            _opened.add(function)
            written_out = "always" if function in written else "never"
            register_jitable(inline=written_out, forceinline=function in direct)(function)
    paths = sorted({function.__code__.co_filename for function in found})
    return hashlib.sha256(b"".join(map(_source, paths))).hexdigest()


_opened: set[Any] = set(pace.NATIVE)


STALE = (ImportError, AttributeError, EOFError, pickle.UnpicklingError)
"""What reading a kept kernel raises where it is of types that are gone, or damaged."""


def own(directory: Path) -> bool:
    """Whether nobody else can put kernels into a directory: they are code that is run."""
    try:
        found = directory.stat()
    except FileNotFoundError:
        return True  # it is made
    except OSError:
        return False
    return found.st_uid in (0, os.geteuid()) and not found.st_mode & stat.S_IWOTH


class Kernel:
    """A compiled function, which may allocate nothing.

    Without numba's allocator no references to arrays are counted: for the coefficients and states
    of three blocks that costs five times the sample.

    Parameters
    ----------
    function : callable
    **options
        Of ``numba.njit``.

    Attributes
    ----------
    entry : callable or None
        What `again` calls, for who calls it every sample; None before the first time.
    """

    def __init__(self, function: Callable[..., object], **options: object) -> None:
        self._function, self._options = function, options
        try:
            self.compiled: Any = self._make(kept=True)
            if not own(Path(self.compiled._cache.cache_path)):
                self.compiled = self._make(kept=False)
        except RuntimeError:  # there is no directory to keep it in
            self.compiled = self._make(kept=False)
        self.entry: Any = None

    def _make(self, kept: bool) -> Any:
        import numba

        return numba.njit(self._function, nogil=True, cache=kept, _nrt=False, **self._options)

    def __call__(self, *arguments: object) -> Any:
        """Call it with arguments of any types; new ones are compiled first."""
        if not self.compiled.signatures:  # takes seconds, and may be interrupted
            kinds = tuple(map(self.compiled.typeof_pyval, arguments))
            try:
                try:
                    self.compiled.compile(kinds)
                except STALE:
                    self.compiled._cache.flush()
                    self.compiled.compile(kinds)
            except OSError:  # no room to keep it, or no right
                self.compiled = self._make(kept=False)
                self.compiled.compile(kinds)
        with INTERRUPT.held():
            return self.compiled(*arguments)

    def again(self, *arguments: object) -> Any:
        """Call it with arguments of the same types each time.

        To find out the types of nested named tuples takes milliseconds: it is left out from the
        second time on.
        """
        if self.entry is None:
            returned = self(*arguments)
            (compiled,) = self.compiled.overloads.values()
            self.entry = compiled.entry_point
            return returned
        with INTERRUPT.held():
            return self.entry(*arguments)


def compile_kernel(function: Callable[..., object], **options: object) -> Kernel:
    """Compile a kernel without the interpreter's lock, kept on disk."""
    return Kernel(function, **options)


def previewed(points: np.ndarray, j: int, after: int, theta: float, T_s: float) -> Reference:
    """Reference at the fraction `theta` (0 to 1) of the interval from row j to row `after`."""
    W_ff = reference_of(points, j)
    if theta != 0.0:
        W_after = reference_of(points, after)
        W_ff = between(W_ff, W_after, theta, T_s)
    return W_ff


def loop_tick(plant: Model, observer: Model, controller: Model) -> Callable[..., Any]:
    """Make the tick of `Loop` for three models: the one that every kernel of a loop calls."""
    compute, commit = step.loop_step(plant, observer, controller)
    write = pack

    def tick(
        points: np.ndarray,
        i: int,
        j: int,
        after: int,
        theta: float,
        T_s: float,
        noise: float,
        p: object,
        s_p: object,
        o: object,
        s_o: object,
        c: object,
        s_c: object,
        rows: np.ndarray,
        r: int,
    ) -> Any:
        W = reference_of(points, i)
        W_ff = previewed(points, j, after, theta, T_s)
        blocks, states = (p, o, c), (s_p, s_o, s_c)
        measured, estimate, u = compute(blocks, states, noise, W, W_ff)
        if math.isfinite(u):
            s_p, s_o, s_c = commit(blocks, states, noise, W, W_ff, measured, estimate, u)
            write(rows, r, W, measured, estimate, u)
        return u, s_p, s_o, s_c

    return tick


def loop_kernel(plant: Model, observer: Model, controller: Model) -> Kernel:
    """Compile the tick of `Loop` for three models, over an array of samples."""
    tick = loop_tick(plant, observer, controller)
    sources = open_sources(tick, inline=tick)

    def kernel(
        points: np.ndarray,
        ahead: int,
        theta: float,
        T_s: float,
        noise: np.ndarray,
        p: object,
        s_p: object,
        o: object,
        s_o: object,
        c: object,
        s_c: object,
        rows: np.ndarray,
    ) -> Any:
        sources  # noqa: B018  part of the key under which the result is kept
        n = noise.size
        for i in range(n):
            j = i + ahead
            u, s_p, s_o, s_c = tick(
                points, i, j, j + 1, theta, T_s, noise[i], p, s_p, o, s_o, c, s_c, rows, i
            )
            if not math.isfinite(u):
                return i, u, s_p, s_o, s_c
        return n, 0.0, s_p, s_o, s_c

    return compile_kernel(kernel)


HEAD, TAKEN, FED, LEAVE = range(4)
"""Cells that `wall_kernel` shares: samples done, samples taken out of the ring, samples that
reference and noise are there for, and whether it shall return."""

BEGUN, DONE = range(2)
"""Columns of `times`: when a sample has begun and ended (ns after its deadline)."""

ENDED, LEFT, STARVED, FULL, UNSAFE, HALTED = range(6)
"""Why `wall_kernel` has returned: no more samples, told to, no reference, nobody has taken the
samples out, a command that is no number, a plant that cannot go on."""


def aim(p: Any, s: Any, w: float) -> None:
    """Show a plant the desired displacement (m) of the sample that comes."""


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
    p_aim, p_halted = getattr(plant, "aim", aim), getattr(plant, "halted", halted)
    p_timed = getattr(plant, "timed", timed)
    sources = ""
    if compiled:
        pace.native()
        sources = open_sources(tick, pace.wait_until, p_aim, p_halted, p_timed, inline=tick)

    def kernel(
        cells: np.ndarray,
        t_0: int,
        T_ns: int,
        spin: int,
        k: int,
        end: int,
        points: np.ndarray,
        ahead: int,
        theta: float,
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
    ) -> Any:
        sources  # noqa: B018
        mask, far = len(rows) - 1, len(points) - 1
        why, u = ENDED, 0.0
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
            r, i, j, after = k & mask, k & far, (k + ahead) & far, (k + ahead + 1) & far
            p_aim(p, s_p, points[i, 0])
            u, s_p, s_o, s_c = tick(
                points, i, j, after, theta, T_s, noise[r], p, s_p, o, s_o, c, s_c, rows, r
            )
            if p_halted(p, s_p):
                why = HALTED
                break
            if not math.isfinite(u):
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
    follow = step.step_of(observer).both
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
            r, j = i & mask, i + ahead
            W_ff = previewed(points, j & far, (j + 1) & far, preview - ahead, T_s)
            signals = reference_of(rows, r), W_ff, estimate_of(rows[r])
            s = commit(c, s, signals, command_of(rows[r]), ())
        return s

    return compile_kernel(kernel) if compiled else kernel


def observer_kernel(observer: Model) -> Callable[..., Any]:
    """Compile an observer alone, over rows of recorded samples; it writes its estimates there."""
    both = step.step_of(observer).both
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
    sources = open_sources(both, previewed, reference_of, estimate_of, pack_command)

    def kernel(
        rows: np.ndarray, points: np.ndarray, preview: float, T_s: float, c: object, s: object
    ) -> Any:
        sources  # noqa: B018
        ahead = int(preview)
        for i in range(len(rows)):
            W = reference_of(rows, i)
            W_ff = previewed(points, i + ahead, i + ahead + 1, preview - ahead, T_s)
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
    sources = open_sources(output, pack_reference)

    def kernel(c: object, k: int, points: np.ndarray) -> None:
        sources  # noqa: B018
        for i in range(len(points)):
            pack_reference(points, i, output(c, k + i))

    return compile_kernel(kernel)


DRIVEN = ("y", "x1", "x2", "x2_dot")
"""Columns that `drive_kernel` writes."""

_Y, _X1, _X2, _X2_DOT = range(len(DRIVEN))


def drive_kernel(plant: Model) -> Callable[..., Any]:
    """Compile a plant model driven by recorded commands; it writes `DRIVEN`."""
    compute, commit, _ = step.step_of(plant)
    truth = plant.truth
    sources = open_sources(compute, commit, truth)

    def kernel(p: object, s: object, noise: np.ndarray, u: np.ndarray, rows: np.ndarray) -> Any:
        sources  # noqa: B018
        for i in range(u.size):
            measured = compute(p, s, (noise[i],))
            true = truth(p, s)
            rows[i, _Y], rows[i, _X1], rows[i, _X2] = measured.y, true.x1, true.x2
            rows[i, _X2_DOT] = true.x2_dot
            s = commit(p, s, (noise[i],), measured, (u[i],))
        return s

    return compile_kernel(kernel)


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

    piece = 8 * CHUNK  # a call costs as much as some hundred samples

    def __init__(
        self, plant: Any, observer: Block, controller: Block, reference: Signal, T_s: float
    ) -> None:
        super().__init__(plant, observer, controller, reference, T_s)
        self._points = reference_kernel(reference.model)
        self._models: tuple[Any, ...] = ()
        self._seen = np.empty((0, 3))  # points from sample k on that a preview has looked at

    def run(self, samples: int, rows: np.ndarray | None = None) -> np.ndarray:
        """Go on for some samples; fewer are returned where the loop cannot go on (`fault`).

        While a block is being changed, in plain Python.
        """
        if rows is None:
            rows = np.empty(samples, SAMPLE)
        done = 0
        while done < samples and self.fault is None:
            if self._changing:
                self.horizon = Horizon(self.horizon.T_s, self.k)
                self.horizon.extend(self.k, [Reference(*p) for p in self._seen.tolist()])
                n = min(samples - done, CHUNK, self._changing)
                done += len(super().run(n, rows[done : done + n]))
                seen = range(self.k, self.k + PREVIEW_MAX)
                self._seen = np.array([self.horizon.ahead(k, 0.0) for k in seen])
            else:
                done += self._run(rows[done:])
        return rows[:done]

    def coming(self, k: int) -> Reference:
        """Reference of a sample that comes next, as far as known the one that previews saw."""
        i = k - self.k
        return Reference(*self._seen[i].tolist()) if i < len(self._seen) else self.reference.at(k)

    @property
    def _changing(self) -> int:
        """Samples until a change has taken effect; 0 where there is none."""
        coming = [block.coming for block in (self.observer, self.controller) if block.coming]
        return min((each.wait + 1 for each in coming), default=0)

    def _run(self, rows: np.ndarray) -> int:
        """Fill `rows`; return how many samples there came to be."""
        samples = len(rows)
        models = (self.plant.model, self.observer.model, self.controller.model)  # type: ignore[attr-defined]
        if models != self._models:
            self._models, self._kernel = models, loop_kernel(*models)
        plant: Any = self.plant
        points = np.empty((samples + PREVIEW_MAX + 1, 3))
        self._points(self.reference.due(self.k + len(self._seen)), self.k, points)
        points[: len(self._seen)] = self._seen
        preview = self.controller.params.preview
        ahead = int(preview)
        numbers = rows.view(np.float64).reshape(samples, -1)
        done, u, plant.s, self.observer.s, self.controller.s = self._kernel.again(
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
            numbers,
        )
        if done:
            j = done - 1 + ahead
            W_ff = previewed(points, j, j + 1, preview - ahead, self.horizon.T_s)
            remember(self.observer, self.controller, numbers[done - 1], W_ff)
        self.k += done
        self._seen = points[done : done + PREVIEW_MAX].copy()
        if done < samples:
            self.fault = LoopFault(
                f"voltage at sample {self.k} is {u}: a command must be a finite number"
            )
        return int(done)


def remember(observer: Block, controller: Block, row: np.ndarray, W_ff: Reference) -> None:
    """Leave in the blocks the signals of the last sample.

    Parameters
    ----------
    observer, controller : Block
        Of a loop that was run by a kernel.
    row : (`COLUMNS`,) array
        The last sample, as the kernel has written it.
    W_ff : Reference
        The reference previewed there.
    """
    measured, estimate = measurement_of(row), estimate_of(row)
    observer.signals, observer.out = (measured,), estimate
    controller.signals = (reference_of(row[np.newaxis], 0), W_ff, estimate)
    controller.out = float(command_of(row))
