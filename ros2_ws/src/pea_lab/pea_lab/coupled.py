r"""What theory says of a loop of several axes whose plant couples them.

The loop is cut at the commands of all axes, L(z) from what the stage is given to what the laws
ask for. S = (I - L)^{-1} is the sensitivity. Its margins

- of one loop at a time, the others closed: those of `pea_lab.check`;
- of all at once: the least modulus of det(I - L), and the disk margin

.. math:: \alpha = \frac{1}{\max_\omega \bar\sigma(S - I/2)},

within which each loop may have a factor of its own, gain between (2 - alpha) / (2 + alpha) and its
inverse, or phase up to 2 atan(alpha / 2), all loops at the same time (P. Seiler, A. Packard and
P. Gahinet, An Introduction to Disk Margins, IEEE Control Syst. Mag. 40(5), 2020). With the largest
singular value in place of the structured one it is a lower bound.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from pea_core.step import step_of
from pea_experiment.experiment import MultiAxis
from pea_lab.check import (
    ROUNDING,
    WIDTHS,
    crossings,
    delay_margin,
    factor,
    limits,
    modulus_margin,
    phase_margin,
    radius,
    refuse_pole,
)
from pea_lab.linear import (
    LinearBlocks,
    LinearLoop,
    Nonlinear,
    System,
    at,
    balanced,
    blocks,
    late,
    linearise,
    minimal,
    nominal,
    reduced,
)
from pea_plant.drivers.simulated import Simulated
from pea_plant.stage import Stage

TOLD = 4
"""Outputs of each axis: y, y', u_applied, x1."""


class CoupledLoop(NamedTuple):
    """The loop of m axes, cut where the commands enter the stage: x+ = A x + B u, u_command = C x.

    A (n, n), B (n, m), C (m, n).
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray

    def closed(self) -> np.ndarray:
        """State matrix with every loop closed."""
        closed: np.ndarray = self.A + self.B @ self.C
        return closed

    def alone(self, axis: int) -> LinearLoop:
        """The loop of one axis, the others closed."""
        others = [i for i in range(len(self.C)) if i != axis]
        A = self.A + self.B[:, others] @ self.C[others]
        none = np.zeros(len(A))
        return LinearLoop(A, self.B[:, axis], self.C[axis], none, 0.0, none)


def plant(experiment: MultiAxis) -> System:
    """The nominal stage: commands of all axes -> y, y', u_applied, x1 of each.

    Raises
    ------
    Nonlinear
        Sensors of different delays behind a matrix.
    """
    params = [one.nodes["plant"].params for one in experiment.each]
    delays = [own.sensor.delay_samples for own in params]
    if len(set(delays)) > 1 and params[0].stage.sensors_to_axes:
        raise Nonlinear("sensors of different delays behind stage.sensors_to_axes are not combined")
    each = [Simulated(nominal(own), experiment.T_s) for own in params]
    stage = Stage(each, experiment.axes)
    model, c = stage.model, stage.c
    compute, commit, _ = step_of(model)
    silent = (0.0,) * len(each)

    def tick(s: Any, v: np.ndarray) -> tuple[tuple[float, ...], Any]:
        measured = compute(c, s, (silent,))
        true = model.truth(c, s)
        told = zip(measured, true, strict=True)
        out = tuple(value for one, own in told for value in (*one, own.x1))
        return out, commit(c, s, (silent,), measured, (tuple(v.tolist()),))

    system = linearise(tick, stage.s, len(each))
    for axis, delay in enumerate(delays):
        system = late(system, delay, TOLD * axis)
    system = minimal(system)
    return reduced(system) if len(c.coupling.A) > 1 else system  # its inverse cancels the filter


def assemble(stage: System, parts: list[LinearBlocks]) -> CoupledLoop:
    """The stage and the observers and laws of its axes as one loop; references at rest at zero."""
    from scipy.linalg import block_diag  # slow to import

    def side_by_side(systems: list[System]) -> System:
        return System(*(block_diag(*matrices) for matrices in zip(*systems, strict=True)))

    O = side_by_side([part.observer for part in parts])  # noqa: E741
    K = side_by_side([part.controller for part in parts])
    n_p, n_o, n_k = len(stage.A), len(O.A), len(K.A)
    told = [TOLD * axis + i for axis in range(len(parts)) for i in range(TOLD - 1)]
    C_m = stage.C[told]
    estimate = np.hstack([O.D @ C_m, O.C, np.zeros((len(O.D), n_k))])
    A = np.vstack(
        [
            np.hstack([stage.A, np.zeros((n_p, n_o + n_k))]),
            np.hstack([O.B @ C_m, O.A, np.zeros((n_o, n_k))]),
            K.B @ estimate + np.hstack([np.zeros((n_k, n_p + n_o)), K.A]),
        ]
    )
    B = np.vstack([stage.B, np.zeros((n_o + n_k, len(parts)))])
    C = K.D @ estimate + np.hstack([np.zeros((len(parts), n_p + n_o)), K.C])
    return CoupledLoop(A, B, C)


def angles(loop: CoupledLoop) -> np.ndarray:
    """Angles omega T_s (rad a sample) at which a loop is looked at: dense near every pole."""
    near = np.concatenate([np.linalg.eigvals(A) for A in (loop.A, loop.closed())])
    near = np.abs(np.angle(near[np.abs(near) > 0.5]))
    w = np.concatenate(
        [np.geomspace(1e-4, math.pi, 400), *(centre + WIDTHS for centre in near if centre > 0.0)]
    )
    return w[(w > 0.0) & (w <= math.pi)]


def differences(loop: CoupledLoop) -> np.ndarray:
    """I - L at `angles`: (k, m, m) array."""
    m = len(loop.C)
    cut = balanced(System(loop.A, loop.B, loop.C, np.zeros((m, m))))
    return np.asarray(np.eye(m) - at(cut, np.exp(1j * angles(loop))))


def together(loop: CoupledLoop) -> dict[str, float]:
    """Margins of all loops at once."""
    D = differences(loop)
    S = np.linalg.inv(D)
    alpha = float(1.0 / np.linalg.norm(S - np.eye(len(loop.C)) / 2.0, 2, axis=(1, 2)).max())
    alpha = min(alpha, 2.0)
    return {
        "determinant_modulus": float(np.abs(np.linalg.det(D)).min()),
        "disk_margin": alpha,
        "disk_gain_lower": (2.0 - alpha) / (2.0 + alpha),
        "disk_gain_upper": (2.0 + alpha) / (2.0 - alpha) if alpha < 2.0 else math.inf,
        "disk_phase_deg": math.degrees(2.0 * math.atan(alpha / 2.0)),
    }


def coupled(experiment: MultiAxis) -> CoupledLoop:
    """The loop of an experiment.

    Raises
    ------
    Nonlinear
        A block has no poles; the text names its axis.
    """
    parts = []
    for one in experiment.each:
        try:
            parts.append(blocks(one))
        except Nonlinear as error:
            raise Nonlinear(f"{one.axis}: {error}") from None
    return assemble(plant(experiment), parts)


def check_axes(experiment: MultiAxis) -> dict[str, Any]:
    """Everything that theory says of a loop of several axes, as ``pea check --json`` prints it.

    Where a block is nonlinear, `linear` is False and `note` says which.
    """
    figures: dict[str, Any] = {
        "experiment": experiment.name,
        "sample_period_ns": experiment.T_ns,
        "linear": True,
        "note": "",
        "axes": {
            one.axis: {node: one.nodes[node].values["type"] for node in ("observer", "controller")}
            for one in experiment.each
        },
    }
    try:
        loop = coupled(experiment)
    except Nonlinear as error:
        return figures | {"linear": False, "note": str(error)}
    largest = radius(loop.closed())
    figures |= {"stable": largest < 1.0 + ROUNDING, "largest_pole": largest}
    if not figures["stable"]:
        return figures
    for i, own in enumerate(figures["axes"].values()):
        own |= _of_axis(loop.alone(i))
    return figures | together(loop)


def refuse_unstable(experiment: MultiAxis) -> None:
    """Refuse a loop that is unstable on the nominal stage; nonlinear ones pass.

    Raises
    ------
    ParameterError
        A pole is outside the unit circle; the text says by how much.
    """
    try:
        loop = coupled(experiment)
    except Nonlinear:
        return
    refuse_pole(experiment.name, experiment.T_s, radius(loop.closed()), "stage")


def _of_axis(alone: LinearLoop) -> dict[str, float | None]:
    """Margins of the loop of one axis, the others closed."""
    cut = limits(lambda gain: radius(alone.closed(gain)))
    smaller, at = factor(*cut), crossings(alone)
    return {
        "gain_margin": smaller if smaller < math.inf else None,
        "gain_margin_lower": cut[0],
        "gain_margin_upper": cut[1],
        "delay_margin_samples": delay_margin(at),
        "phase_margin_deg": phase_margin(at),
        "modulus_margin": modulus_margin(alone),
    }


def rows(figures: dict[str, Any]) -> list[tuple[str, ...]]:
    """What `check_axes` found, as lines of a table: a name, and a value of each axis or of all."""

    def number(value: object, none: str = "-") -> str:
        return none if value is None else f"{value:.4g}"

    own = list(figures["axes"].values())
    found = [(node, *(each[node] for each in own)) for node in ("controller", "observer")]
    if not figures["linear"]:
        return found
    stable = figures["stable"]
    found.append(("stable on the nominal stage", "yes" if stable else "NO"))
    found.append(("largest pole |z|", number(figures["largest_pole"])))
    if not stable:
        return found
    for name, text, none in (
        ("gain_margin", "gain margin, others closed", "above 100"),
        ("delay_margin_samples", "delay margin (samples)", "any delay"),
        ("phase_margin_deg", "phase margin (deg)", "any phase"),
        ("modulus_margin", "modulus margin", "-"),
    ):
        found.append((text, *(number(each[name], none) for each in own)))
    gains = f"{number(figures['disk_gain_lower'])} to {number(figures['disk_gain_upper'])}"
    found += [
        ("least |det(I - L)|", number(figures["determinant_modulus"])),
        ("disk margin, all loops at once", number(figures["disk_margin"])),
        ("  gain of each loop", gains),
        ("  phase of each loop (deg)", number(figures["disk_phase_deg"])),
    ]
    return found
