"""The loop in wall time: a thread of its own that never waits for the interpreter.

One compiled call runs from the first sample to the last and keeps time by itself. What it needs
of the reference and of the noise is prepared ahead, what it has computed is taken out behind it,
through rings of fixed size: one thread writes, another reads, and nobody waits for anybody. Where
one falls a whole ring behind, the run ends with an error; nothing is left out, nothing is lost.

For a change of parameters the other thread designs; then the call returns between two samples,
takes the interpreter, swaps coefficients, and goes on. What that has cost stands in the lateness
of the next samples.
"""

from __future__ import annotations

import threading
from typing import Any, NamedTuple

import numpy as np

from pea_core import pace
from pea_core.block import Block, Signal
from pea_core.compiled import (
    FED,
    FULL,
    HEAD,
    LEAVE,
    LEFT,
    STARVED,
    TAKEN,
    UNSAFE,
    previewed,
    reference_kernel,
    remember,
    wall_kernel,
)
from pea_core.config import NODES
from pea_core.loop import CHUNK, PREVIEW_MAX, LoopFault
from pea_core.pace import Standing
from pea_core.signals import SAMPLE

CAPACITY = 1 << 16
"""Samples in a ring, a power of two: 3.3 s at 20 kHz."""

LEAD_NS = 5_000_000
"""From the start of the thread to sample 0 (ns)."""


RENEWED = 8 * CHUNK
"""Samples of a new reference that are computed before the loop goes on."""


class Piece(NamedTuple):
    """Samples taken out of the ring.

    Attributes
    ----------
    k : int
        Number of the first one.
    rows : (n,) array of `SAMPLE`
        What every block said.
    times : (n, 2) array of int64
        How long after its deadline each has begun and ended (ns).
    """

    k: int
    rows: np.ndarray
    times: np.ndarray


class Change(NamedTuple):
    """New parameters of a block.

    Attributes
    ----------
    k : int
        First sample that goes by them.
    name : str
        One of `NODES`.
    old, new : dataclass
        Parameters before and after.
    """

    k: int
    name: str
    old: Any
    new: Any


class WallLoop:
    """Plant, observer, controller and reference, one sample each T_s of wall time.

    One other thread, always the same, calls its methods.

    Parameters
    ----------
    plant : Block
        Simulated plant with ``noise(n)``.
    observer, controller : Block
        Estimator and control law.
    reference : Signal
        Desired displacement.
    T_ns : int
        Sample period (ns).
    samples : int
        Length of the run.
    cpu : int, optional
        Core for the loop.
    compiled : bool
        False: plain Python, which shares the interpreter and keeps no deadline; to look into it.
    capacity : int
        Samples in a ring, a power of two.

    Attributes
    ----------
    blocks : dict
        The four blocks, by name.
    fault : Exception or None
        Why the loop could not go on; final once `alive` is False.
    standing : Standing or None
        What the system has granted its thread.
    """

    def __init__(
        self,
        plant: Any,
        observer: Block,
        controller: Block,
        reference: Signal,
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
        self.blocks: dict[str, Block | Signal] = dict(
            zip(NODES, (plant, observer, controller, reference), strict=True)
        )
        self.T_ns = T_ns
        self.samples = samples
        self.cpu = cpu
        self.fault: Exception | None = None
        self.standing: Standing | None = None
        self._mask = capacity - 1
        self._cells = pace.cells(4)
        self._points = np.full((capacity, 3), np.nan)
        self._noise = np.full(capacity, np.nan)
        self._rows = np.full((capacity, len(SAMPLE.names or ())), np.nan)
        self._times = np.full((capacity, 2), -1)
        self._points_end = self._noise_end = 0
        self._lock = threading.Lock()
        self._wanted: list[tuple[str, Any, Any]] = []
        self._made: list[Change] = []
        self._stopping = False
        self._remembered = 0
        self._t_0 = 0
        self._compute = reference_kernel(reference.model) if compiled else None
        self._kernel = wall_kernel(plant.model, observer.model, controller.model, compiled)
        self._thread = threading.Thread(target=self._run, name="loop")
        self._enter(0, 0)  # compiles
        self.feed()

    def start(self) -> None:
        """Start the clock."""
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether samples may still come."""
        return self._thread.is_alive()

    def feed(self) -> None:
        """Prepare reference and noise as far ahead as the rings go."""
        with self._lock:
            self._feed(pace.look(self._cells, HEAD) + self._mask)  # the last one stays known

    def _feed(self, limit: int) -> None:
        """Prepare up to sample `limit`, exclusive; the lock is held."""
        points_end = min(limit, self.samples + PREVIEW_MAX + 1)
        n = points_end - self._points_end
        if n > 0:
            points = np.empty((n, 3))
            if self._compute is not None:
                self._compute(self.reference.c, self._points_end, points)
            else:
                points[:] = [self.reference.at(self._points_end + i) for i in range(n)]
            self._points[np.arange(self._points_end, points_end) & self._mask] = points
            self._points_end = points_end
        noise_end = min(limit, self.samples)
        n = noise_end - self._noise_end
        if n > 0:
            slots = np.arange(self._noise_end, noise_end) & self._mask
            self._noise[slots] = self.plant.noise(n)
            self._noise_end = noise_end
        pace.tell(self._cells, FED, min(self._noise_end, self._points_end - PREVIEW_MAX - 1))

    def take(self, leave: int = 0) -> Piece:
        """Take out what was computed since the last time, all but the last `leave` samples."""
        k = pace.look(self._cells, TAKEN)
        end = max(pace.look(self._cells, HEAD) - leave, k)
        slots = np.arange(k, end) & self._mask
        rows, times = self._rows[slots], self._times[slots]
        pace.tell(self._cells, TAKEN, end)
        return Piece(k, rows.reshape(-1).view(SAMPLE), times)

    def ahead(self) -> np.ndarray:
        """The reference of the samples after the last one: (n, 3) array, SI; for a loop at rest."""
        k = pace.look(self._cells, HEAD)
        after: np.ndarray = np.arange(k, min(k + PREVIEW_MAX + 1, self._points_end))
        points: np.ndarray = self._points[after & self._mask]
        return points

    def change(self, name: str, params: Any) -> None:
        """Have a block retuned between two samples, soon.

        Raises
        ------
        ParameterError
            It cannot be designed with them.
        """
        c = self.blocks[name].model.design(params, self.plant.T_s)
        with self._lock:
            self._wanted.append((name, params, c))
            pace.tell(self._cells, LEAVE, 1)

    def changes(self) -> list[Change]:
        """What was retuned since the last time."""
        with self._lock:
            made, self._made = self._made, []
        return made

    def stop(self) -> None:
        """End the loop between two samples, and wait until it has ended."""
        with self._lock:
            self._stopping = True
            pace.tell(self._cells, LEAVE, 1)
        if self._thread.ident is not None:
            self._thread.join()

    def _run(self) -> None:
        """Run to the end: the thread."""
        try:
            self.standing = pace.settle(self.cpu)
            self._t_0 = pace.now() + LEAD_NS
            while self._enter(pace.look(self._cells, HEAD), self.samples) == LEFT:
                if not self._retune():
                    return
        except Exception as error:  # told by whoever drains the ring
            self.fault = error

    def _enter(self, k: int, end: int) -> int:
        """Run the kernel from sample k on; say why it has returned."""
        preview = self.controller.params.preview
        ahead = int(preview)
        why, k, u, self.plant.s, self.observer.s, self.controller.s = self._kernel(
            self._cells,
            self._t_0,
            self.T_ns,
            min(pace.SPIN_NS, self.T_ns // 2),
            k,
            end,
            self._points,
            ahead,
            preview - ahead,
            self.plant.T_s,
            self._noise,
            self.plant.c,
            self.plant.s,
            self.observer.c,
            self.observer.s,
            self.controller.c,
            self.controller.s,
            self._rows,
            self._times,
        )
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
        """Make the changes that wait; say whether the loop goes on."""
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
                self._made.append(Change(k, name, block.params, params))
                block.adopt(params, c)
                if block is self.reference:
                    self._points_end = k
                    self._feed(k + min(RENEWED, self._mask))
        return True

    def _remember(self, k: int) -> None:
        """Leave the signals of sample k - 1 in the blocks."""
        preview = self.controller.params.preview
        ahead = int(preview)
        j = k - 1 + ahead
        W_ff = previewed(
            self._points, j & self._mask, (j + 1) & self._mask, preview - ahead, self.plant.T_s
        )
        remember(self.observer, self.controller, self._rows[(k - 1) & self._mask], W_ff)
        self._remembered = k
