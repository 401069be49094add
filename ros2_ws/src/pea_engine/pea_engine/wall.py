"""The loop in wall time: its thread never waits for the Python interpreter.

One compiled call runs from the first sample to the last and keeps the deadlines by itself. A second
thread prepares the reference and the noise in advance, and takes out the results. Both use rings of
fixed size: one thread writes, the other reads, and none waits for the other. If one thread falls a
whole ring behind, the run ends with an error, so that no sample is omitted or lost.

For a change of parameters the second thread computes the new design. Then the compiled call returns
between two samples, takes the interpreter, swaps the coefficients, and goes on. The lateness of the
next samples shows the cost. A block of another type is compiled before, by a third thread.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from pea_core.axes import (
    POINT,
    WIDTH,
    Several,
    each,
    number_of_axes,
    per_axis,
    preview_of,
    previewed,
    rows_of,
    samples_of,
    split,
)
from pea_core.block import Block, Signal
from pea_core.config import NODES
from pea_core.live import Live
from pea_core.loop import CHUNK, PREVIEW_MAX, LoopFault
from pea_core.signals import Reference
from pea_engine import pace
from pea_engine.compiled import no_command, remember
from pea_engine.kernels import (
    FED,
    FULL,
    HALTED,
    HEAD,
    LEAVE,
    LEFT,
    STARVED,
    TAKEN,
    UNSAFE,
    law_follow_kernel,
    observer_follow_kernel,
    reference_kernel,
    wall_kernel,
)
from pea_engine.pace import Standing

CAPACITY = 1 << 16
"""Samples in a ring, a power of two: 3.3 s at 20 kHz."""

LEAD_NS = 5_000_000
"""Time from the start of the thread to sample 0 (ns)."""


JOIN = 0.05
"""Seconds between two checks whether a loop that should end hangs."""

RENEWED = 8 * CHUNK
"""Samples of a new reference that are computed before the loop goes on."""


class RingPiece(NamedTuple):
    """Samples taken out of the ring.

    Attributes
    ----------
    k : int
        Number of the first sample.
    rows : (n,) or (n, axes) array of `SAMPLE`
        Outputs of all blocks.
    times : (n, 2) array of int64
        Times (ns) after its deadline at which each sample began and ended.
    """

    k: int
    rows: np.ndarray
    times: np.ndarray


class Change(NamedTuple):
    """New parameters of a block.

    Attributes
    ----------
    k : int
        First sample computed with them.
    name : str
        One of `NODES`.
    old, new : dataclass, or tuple of them
        Parameters before and after; with several axes, one for each axis.
    """

    k: int
    name: str
    old: Any
    new: Any


class WallLoop:
    """Plant, observer, controller and reference, one sample in each T_s of wall time.

    Only one other thread may call its methods.

    Parameters
    ----------
    plant : Block
        Plant with ``noise(n)``. It has ``paced`` if its device sets the pace, and ``halt()``
        returns why it is `HALTED`.
    observer, controller : Block or Several
        Estimator and control law.
    reference : Signal or Several
        Desired displacement.
    T_ns : int
        Sample period (ns).
    samples : int
        Length of the run.
    cpu : int, optional
        Core of the loop.
    compiled : bool
        False: plain Python, which misses deadlines; for tests and debugging.
    capacity : int
        Samples in a ring, a power of two.

    Attributes
    ----------
    blocks : dict
        The four blocks, by name.
    fault : Exception or None
        Why the loop could not go on; final once `alive` is False.
    standing : Standing or None
        Core, priority and timers that the system has granted to the thread.
    """

    def __init__(
        self,
        plant: Any,
        observer: Any,
        controller: Any,
        reference: Any,
        T_ns: int,
        samples: int,
        cpu: int | None = None,
        compiled: bool = True,
        capacity: int = CAPACITY,
    ) -> None:
        self.plant = plant
        self.observer = observer
        self.controller = controller
        self.reference = reference
        self.axes = number_of_axes(controller)
        self.blocks: dict[str, Block | Signal | Several] = dict(
            zip(NODES, (plant, observer, controller, reference), strict=True)
        )
        self.T_ns = T_ns
        self.samples = samples
        self.cpu = cpu
        self.fault: Exception | None = None
        self.standing: Standing | None = None
        self._mask = capacity - 1
        self._cells = pace.cells(4)
        # the ring holds as many past points of the reference as future ones
        self._far = (1 << (2 * (capacity + PREVIEW_MAX)).bit_length()) - 1
        self._points = np.full((self._far + 1, POINT * self.axes), np.nan)
        self._noise = np.full(capacity if self.axes == 1 else (capacity, self.axes), np.nan)
        self._rows = np.full((capacity, WIDTH * self.axes), np.nan)
        self._times = np.full((capacity, 2), -1)
        self._points_end = self._noise_end = 0
        self._lock = threading.Lock()
        self._wanted: list[tuple[str, Any, Any]] = []
        self._designed = {
            name: (block.model, block.c, block.s)
            for name, block in (("observer", observer), ("controller", controller))
        }
        self._builder: threading.Thread | None = None
        self._beside_since: dict[tuple[str, int], int] = {}
        self._made: list[Change] = []
        self._stopping = False
        self._remembered = 0
        self._t_0 = 0
        self._paced = getattr(plant, "paced", False)  # its device sets the pace: no deadline here
        self._compute = reference_kernel(reference.model) if compiled else None
        self._compiled = compiled
        self._kernels: dict[tuple[int, int], Callable[..., Any]] = {}
        self._beside: dict[Any, Callable[..., Any]] = {}
        self._thread = threading.Thread(target=self._run, name="loop", daemon=True)
        self._prepare(*self._designed.values())
        self.feed()

    def start(self) -> None:
        """Start the clock."""
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether samples may still come."""
        return self._thread.is_alive()

    @property
    def waiting(self) -> int:
        """Number of samples in the ring that were not taken out yet."""
        return pace.look(self._cells, HEAD) - pace.look(self._cells, TAKEN)

    def feed(self) -> None:
        """Prepare reference and noise as far ahead as the rings go."""
        with self._lock:
            self._feed(pace.look(self._cells, HEAD) + self._mask)  # the last one stays known

    def _feed(self, limit: int) -> None:
        """Prepare up to sample `limit`, exclusive; the lock is held."""
        points_end = min(limit, self.samples) + PREVIEW_MAX + 1
        n = points_end - self._points_end
        if n > 0:
            points = np.empty((n, POINT * self.axes))
            if self._compute is not None:
                self._compute(self.reference.due(self._points_end), self._points_end, points)
            else:
                known = [self.reference.at(self._points_end + i) for i in range(n)]
                points[:] = np.reshape(known, points.shape)
            self._points[np.arange(self._points_end, points_end) & self._far] = points
            self._points_end = points_end
        noise_end = min(limit, self.samples)
        n = noise_end - self._noise_end
        if n > 0:
            slots = np.arange(self._noise_end, noise_end) & self._mask
            self._noise[slots] = self.plant.noise(n)
            self._noise_end = noise_end
        pace.tell(self._cells, FED, min(self._noise_end, self._points_end - PREVIEW_MAX - 1))

    def take(self, leave: int = 0) -> RingPiece:
        """Take out the samples computed since the last call, all but the last `leave`."""
        k = pace.look(self._cells, TAKEN)
        end = max(pace.look(self._cells, HEAD) - leave, k)
        slots = np.arange(k, end) & self._mask
        rows, times = self._rows[slots], self._times[slots]
        pace.tell(self._cells, TAKEN, end)
        return RingPiece(k, samples_of(rows, self.axes), times)

    def ahead(self) -> np.ndarray:
        """The reference after the last sample, (n, axes x 3); call it when the loop has ended."""
        k = pace.look(self._cells, HEAD)
        after: np.ndarray = np.arange(k, min(k + PREVIEW_MAX + 1, self._points_end))
        points: np.ndarray = self._points[after & self._far]
        return points

    def change(self, name: str, params: Any) -> None:
        """Change the parameters of a block between two of the next samples.

        A block of another type is compiled first.

        Raises
        ------
        ParameterError
            The block cannot be designed with them.
        """
        block = self.blocks[name]
        c = block.designed(params)
        before = self._builder if self._builder and self._builder.is_alive() else None
        another = False
        if isinstance(block, Live | Several) and name in self._designed:
            rest = block.rest(params, c)
            another = rest[0] is not self._designed[name][0]
            self._designed[name] = rest
        if not another and before is None:
            self._want(name, params, c)
            return
        self._builder = threading.Thread(
            target=self._build, args=(before, dict(self._designed), name, params, c), daemon=True
        )
        self._builder.start()

    def _build(
        self,
        before: threading.Thread | None,
        designed: dict[str, tuple[object, object, object]],
        name: str,
        params: object,
        c: object,
    ) -> None:
        """Compile the blocks `designed` when the thread `before` has ended; request the change."""
        if before is not None:
            before.join()
        self._prepare(designed["observer"], designed["controller"])
        self._want(name, params, c)

    def _want(self, name: str, params: object, c: object) -> None:
        with self._lock:
            self._wanted.append((name, params, c))
            pace.tell(self._cells, LEAVE, 1)

    def _prepare(self, observer: tuple[Any, Any, Any], controller: tuple[Any, Any, Any]) -> None:
        """Compile the loop for two models, and the kernels with which a new type follows it."""
        key = (id(observer[0]), id(controller[0]))  # models are kept: nothing is given up
        if key not in self._kernels:
            kernel = wall_kernel(self.plant.model, observer[0], controller[0], self._compiled)
            self._call(kernel, 0, 0, observer[1:], controller[1:])
            self._kernels[key] = kernel
        points, rows = self._of_axis(0)
        for make, (model, *values) in (
            (observer_follow_kernel, observer),
            (law_follow_kernel, controller),
        ):
            if self.axes == 1:
                models, (c, s) = (model,), ((value,) for value in values)
            else:
                models, (c, s) = model.models, values
            for one, c_one, s_one in zip(models, c, s, strict=True):
                inner = getattr(one, "model", None)
                if inner is not None and inner not in self._beside and self._builder is not None:
                    follow = make(inner, self._compiled)
                    follow(0, 0, points, 0.0, self.plant.T_s, rows, c_one.c, s_one.s)
                    self._beside[inner] = follow

    def _of_axis(self, axis: int) -> tuple[np.ndarray, np.ndarray]:
        """Points and rows of one axis."""
        if self.axes == 1:
            return self._points, self._rows
        points = self._points[:, POINT * axis : POINT * (axis + 1)]
        return points, self._rows[:, WIDTH * axis : WIDTH * (axis + 1)]

    def changes(self) -> list[Change]:
        """Changes that took effect since the last call."""
        with self._lock:
            made, self._made = self._made, []
        return made

    def stop(self, hangs: Callable[[], bool] = lambda: False) -> bool:
        """End the loop between two samples, and wait until it has ended; whether it has.

        Parameters
        ----------
        hangs : callable
            Whether to stop waiting, because the loop hangs.
        """
        with self._lock:
            self._stopping = True
            pace.tell(self._cells, LEAVE, 1)
        while self._thread.is_alive() and not hangs():
            self._thread.join(JOIN)
        return not self._thread.is_alive()

    def _run(self) -> None:
        """Body of the thread: run to the end."""
        try:
            self.standing = pace.settle(self.cpu)
            self._t_0 = 0 if self._paced else pace.now() + LEAD_NS
            while (k := pace.look(self._cells, HEAD)) < self.samples:
                left = self._enter(k, self._until(k)) == LEFT
                self._advance()
                if left and not self._retune():
                    return
                self._take_over()
        except Exception as error:  # reported by the thread that drains the ring
            self.fault = error

    def _until(self, k: int) -> int:
        """Sample at which the kernel must return: a new type that follows it reads the ring."""
        waits = [live.coming.wait for _, _, live in self._live if live.coming is not None]
        return min([self.samples, *(k + min(wait, self._mask // 2) for wait in waits)])

    @property
    def _live(self) -> list[tuple[str, int, Block]]:
        """Name, axis and block of all blocks that may be changed."""
        roles = zip(self._designed, (self.observer, self.controller), strict=True)
        return [(name, axis, one) for name, block in roles for axis, one in enumerate(each(block))]

    def _call(self, kernel: Callable[..., Any], k: int, end: int, *blocks: Any) -> Any:
        """Call a kernel with coefficients and state of observer and controller."""
        (o, s_o), (c, s_c) = blocks
        ahead, theta = split(preview_of(self.controller.params))
        return kernel(
            self._cells,
            self._t_0,
            0 if self._paced else self.T_ns,
            min(pace.SPIN_NS, self.T_ns // 2),
            k,
            end,
            self._points,
            ahead,
            theta,
            self.plant.T_s,
            self._noise,
            self.plant.c,
            self.plant.s,
            o,
            s_o,
            c,
            s_c,
            self._rows,
            self._times,
            no_command(self.axes),
        )

    def _enter(self, k: int, end: int) -> int:
        """Run the kernel from sample k on; return why it has stopped."""
        kernel = self._kernels[id(self.observer.model), id(self.controller.model)]
        blocks = [(block.c, block.s) for block in (self.observer, self.controller)]
        why, k, u, self.plant.s, self.observer.s, self.controller.s = self._call(
            kernel, k, end, *blocks
        )
        if why == HALTED:
            raise LoopFault(self.plant.halt())
        if why in (STARVED, FULL, UNSAFE):
            raise LoopFault(
                {
                    STARVED: f"reference and noise are prepared up to sample {k} only: the "
                    "process beside the loop does not keep up",
                    FULL: f"sample {k}: the {self._mask + 1} samples before it are not recorded "
                    "yet: the recording does not keep up",
                    UNSAFE: f"voltage at sample {k} is {u}: a command must be a finite number",
                }[why]
            )
        return int(why)

    def _retune(self) -> bool:
        """Apply pending changes; return whether the loop continues."""
        with self._lock:
            pace.tell(self._cells, LEAVE, 0)
            if self._stopping:
                return False
            wanted, self._wanted = self._wanted, []
            k = pace.look(self._cells, HEAD)
            if k > self._remembered:
                self._remember(k)
            for name, params, c in wanted:
                block = self.blocks[name]
                self._made.append(Change(k, name, block.planned, params))
                block.adopt(params, c)
                for axis in range(self.axes):
                    self._beside_since[name, axis] = k
                if block is self.reference:  # what a preview has looked at stays
                    self._points_end = min(self._points_end, k + PREVIEW_MAX)
                    self._feed(k + min(RENEWED, self._mask))
        return True

    def _remember(self, k: int) -> None:
        """Store the signals of sample k - 1 in the blocks."""
        W_ff = self._previewed(k - 1, preview_of(self.controller.params))
        remember(self.observer, self.controller, self._rows[(k - 1) & self._mask], W_ff)
        self._remembered = k

    def _advance(self) -> None:
        """Run the new types that follow the loop up to its present sample."""
        k = pace.look(self._cells, HEAD)
        for name, axis, live in self._live:
            coming = live.coming
            since = self._beside_since.get((name, axis), k)
            if coming is not None and coming.wait > 0 and since < k:
                block = coming.block
                points, rows = self._of_axis(axis)
                preview = getattr(block.params, "preview", 0.0)
                block.s = self._beside[block.model](
                    since, k, points, preview, self.plant.T_s, rows, block.c, block.s
                )
                coming.wait -= k - since
                self._beside_since[name, axis] = k

    def _take_over(self) -> None:
        """Apply the changes that are due at the next sample.

        Outputs change no state, so they are computed first: the old and the new block compare them.
        """
        k = pace.look(self._cells, HEAD)
        due = [(name, axis, live) for name, axis, live in self._live if _due(live)]
        if not due or k >= min(self.samples, pace.look(self._cells, FED)):
            return
        plant, observer = self.plant, self.observer
        layout = rows_of(self.axes)
        noise = layout.noise(self._noise, k & self._mask)
        measured = plant.model.output(plant.c, plant.s, noise)
        for name, axis, live in due:
            if name == "observer" and isinstance(live, Live):
                own = (per_axis(measured)[axis],)
                live.take_over(own, own)
        estimate = observer.model.output(observer.c, observer.s, measured)
        estimates = per_axis(estimate)
        for name, axis, live in due:
            if name == "controller" and isinstance(live, Live):
                points, _ = self._of_axis(axis)
                W = Reference(*points[k & self._far])
                old, new = (
                    (W, self._ahead(points, k, params.preview), estimates[axis])
                    for params in (live.params, live.planned)
                )
                live.take_over(old, new)

    def _ahead(self, points: np.ndarray, k: int, preview: float) -> Reference:
        """Reference of one axis at k + preview."""
        return previewed(points, k, self._far, *split(preview), self.plant.T_s)

    def _previewed(self, k: int, preview: Any) -> Any:
        """Reference at k + preview; with several axes, one for each axis."""
        found = tuple(
            self._ahead(self._of_axis(axis)[0], k, own)
            for axis, own in enumerate(per_axis(preview))
        )
        return found[0] if self.axes == 1 else found


def _due(live: Block) -> bool:
    """Whether a change of a block takes effect at the next sample."""
    return live.coming is not None and live.coming.wait == 0
