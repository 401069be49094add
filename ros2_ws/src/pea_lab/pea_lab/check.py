r"""What theory says of a loop before anything moves.

Everything is computed from the linear sampled loop of `linear`, on the nominal plant.

Poles
    Eigenvalues of the closed loop; stable where all |z| < 1.
Gain margin at the command
    Between which factors the command u may be changed, the observer told of the voltage that is
    really applied: the loop cut at u.
Gain margin at the actuator
    Between which factors of its own gain the actuator may be, the observer told nothing of it: an
    error of K, and hysteresis, whose local gain varies around one.
Gain margin
    One number for both: the factor, up or down, that makes the loop unstable at either place. What
    judges gains (`guard`, `tune`) judges by it.
Delay margin
    How many samples later u may come, the observer told of it: the loop cut at u.
Phase margin
    The least phase, in degrees, between L and the point at which it becomes unstable, where |L| is
    1: the loop cut at u.
Modulus margin
    1 / max |S|, S = 1 / (1 - L) with the loop cut at u: the least distance of L from the point at
    which it becomes unstable.
Noise
    With n the white noise of y, P = A P A^T + E E^T (Lyapunov) gives the variances of x1 and u.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from pea_controller import model as controllers
from pea_core.params import ParameterError
from pea_core.units import NM
from pea_experiment.experiment import Experiment
from pea_lab.linear import (
    LinearLoop,
    Nonlinear,
    System,
    assemble,
    at,
    balanced,
    blocks,
    learns,
    minimal,
)
from pea_lab.settling import called, looks, refuse_steps
from pea_observer.matching import matching

ROUNDING = 1e-9
"""How far beyond the unit circle rounding may put a pole that is on it."""

WIDTHS = np.concatenate([-np.geomspace(1e-1, 1e-5, 15), [0.0], np.geomspace(1e-5, 1e-1, 15)])
"""Where, beside the angle of a pole, a loop is looked at (rad)."""

GAINS = 100.0
"""Margins are looked for from 1/100 to 100 times the gain."""


def poles(loop: LinearLoop, gain: float = 1.0) -> np.ndarray:
    """Poles of the closed loop, largest first; states that nothing moves or sees have none."""
    inputs = np.column_stack([loop.B, loop.E])
    outputs = np.vstack([loop.C, loop.C_1])
    D = np.zeros((2, 2))
    A = minimal(System(loop.closed(gain), inputs, outputs, D)).A
    z = np.linalg.eigvals(A)
    return z[np.argsort(-np.abs(z), kind="stable")]


def radius(A: np.ndarray) -> float:
    """Largest |z| of the eigenvalues of A; 0 where there are none."""
    return float(np.abs(np.linalg.eigvals(A)).max(initial=0.0))


def modulus_margin(loop: LinearLoop) -> float:
    """1 / max |S| of a stable loop, on a grid that is dense near every pole, open and closed."""
    near = np.concatenate([np.linalg.eigvals(A) for A in (loop.A, loop.closed())])
    near = np.abs(np.angle(near[np.abs(near) > 0.5]))
    w = np.concatenate(
        [np.geomspace(1e-4, math.pi, 400), *(centre + WIDTHS for centre in near if centre > 0.0)]
    )
    z = np.exp(1j * w[(w > 0.0) & (w <= math.pi)])
    cut = balanced(System(loop.A, loop.B[:, None], loop.C[None, :], np.zeros((1, 1))))
    L = at(cut, z)[:, 0, 0]
    return float(np.abs(1.0 - L).min())


def limits(largest: Callable[[float], float]) -> tuple[float, float | None]:
    """Between which gains around 1 a loop is stable.

    Parameters
    ----------
    largest : callable
        Largest |z| at a gain.

    Returns
    -------
    (lower, upper)
        0 and None where there is no limit down to 1/`GAINS` and up to `GAINS`.
    """
    from scipy.optimize import brentq  # slow to import, and not needed to run

    def over(gain: float) -> float:
        return largest(gain) - 1.0 - ROUNDING

    found: list[float | None] = []
    for direction in (-1.0, 1.0):
        inside, edge = 1.0, None
        for exponent in np.arange(0.01, math.log(GAINS), 0.01):
            gain = math.exp(direction * exponent)
            if over(gain) > 0.0:
                edge = float(brentq(over, inside, gain, xtol=1e-9))
                break
            inside = gain
        found.append(edge)
    return found[0] or 0.0, found[1]


def factor(lower: float, upper: float | None) -> float:
    """Limits of a gain as one number: the factor up or down that is borne."""
    return min(upper or math.inf, 1.0 / lower if lower > 0.0 else math.inf)


def response(loop: LinearLoop, omega_T: np.ndarray) -> np.ndarray:
    """Frequency response of the loop cut at u, at angles omega T_s (rad a sample)."""
    cut = balanced(System(loop.A, loop.B[:, None], loop.C[None, :], np.zeros((1, 1))))
    return at(cut, np.exp(1j * omega_T))[:, 0, 0]


def crossings(loop: LinearLoop) -> list[tuple[float, float]]:
    """Angle omega T_s (rad a sample) and phase (rad, 0 to 2 pi) of L wherever |L| is 1."""
    from scipy.optimize import brentq

    omega_T = np.geomspace(1e-5, math.pi, 4000)

    def size(angle: float) -> float:
        return math.log(abs(response(loop, np.array([angle]))[0]) + 1e-300)

    sizes = np.log(np.abs(response(loop, omega_T)) + 1e-300)
    found = []
    for i in np.flatnonzero(sizes[:-1] * sizes[1:] < 0.0):
        angle = brentq(size, omega_T[i], omega_T[i + 1])
        phase = np.angle(response(loop, np.array([angle]))[0]) % (2.0 * math.pi)
        found.append((float(angle), float(phase)))
    return found


def delay_margin(at: list[tuple[float, float]]) -> float | None:
    """How many samples later u may come: the least phase at |L| = 1 over its frequency.

    None where |L| is never 1: no delay does harm. `at` comes from `crossings`.
    """
    return min((phase / angle for angle, phase in at), default=None)


def phase_margin(at: list[tuple[float, float]]) -> float | None:
    """Least phase (deg), ahead or behind, to instability where |L| is 1; None where it never is."""
    return min((math.degrees(min(phase, 2.0 * math.pi - phase)) for _, phase in at), default=None)


def covariance(A: np.ndarray, E: np.ndarray) -> np.ndarray:
    """P (n, n) of P = A P A^T + E E^T for a stable A, by doubling."""
    P, power = np.outer(E, E), A
    for _ in range(60):
        P = P + power @ P @ power.T
        power = power @ power
    return P


def noise(loop: LinearLoop) -> dict[str, float]:
    """What 1 nm rms of sensor noise does: rms of x1 (nm), of u and of its step (V)."""
    A, E = loop.closed(), loop.E + loop.B * loop.F
    outputs = np.vstack([loop.C_1, loop.C])
    A, E_, C, _ = minimal(System(A, E[:, None], outputs, np.zeros((2, 1))))
    P, E, C_1, C_u = covariance(A, E_[:, 0]), E_[:, 0], C[0], C[1]
    step = C_u @ A - C_u
    return {
        "floor_nm": math.sqrt(C_1 @ P @ C_1),
        "voltage_V": math.sqrt(C_u @ P @ C_u + loop.F**2) * NM,
        "step_V": math.sqrt(step @ P @ step + (C_u @ E - loop.F) ** 2 + loop.F**2) * NM,
    }


def equivalent_pid(experiment: Experiment) -> dict[str, float] | None:
    """Gains of the PID + D^2 law that the law is, in the paper's units; None where it is none."""
    node = experiment.nodes["controller"]
    of_law = getattr(
        controllers.MODELS[controllers.CHOICE.type_of(node.params)], "equivalent_pid", None
    )
    return None if of_law is None else of_law(node.params)


OF_POLES = (
    "stable",
    "largest_pole",
    "poles",
    "gain_margin",
    "gain_margin_lower",
    "gain_margin_upper",
    "delay_margin_samples",
    "phase_margin_deg",
    "modulus_margin",
    "actuator_gain_lower",
    "actuator_gain_upper",
    "noise_to_voltage_V_per_nm",
    "noise_nm",
    "noise_floor_nm",
    "voltage_noise_V",
    "voltage_step_noise_V",
)
"""Figures that rest on the poles of the loop: None where it is nonlinear, or unstable."""


def check(experiment: Experiment) -> dict[str, Any]:
    """Everything that theory says, as printed by ``pea check --json``.

    Where a block is nonlinear, `linear` is False, `note` says which, and what rests on poles is
    None. Gains and margins without a limit are None (the lower ones 0).
    """
    met = matching(experiment.nominal, experiment.T_s)
    noise_nm = experiment.nodes["plant"].params.sensor.noise_nm
    figures: dict[str, Any] = {
        "experiment": experiment.name,
        "controller": experiment.nodes["controller"].values["type"],
        "observer": experiment.nodes["observer"].values["type"],
        "sample_period_ns": experiment.T_ns,
        "linear": True,
        "note": "",
        **dict.fromkeys(OF_POLES),
        "equivalent_pid": equivalent_pid(experiment),
        "matching": {
            "rank_CB": met.rank_CB,
            "rank_B": met.rank_B,
            "continuous": met.holds,
            "CB_d_um_per_V": met.CB_d * 1e6,
            "sampled": met.CB_d != 0.0,
        },
    }
    try:
        parts = blocks(experiment)
    except Nonlinear as error:
        figures |= {"linear": False, "note": str(error)}
        return figures
    notes = []
    if not parts.everywhere:
        notes.append("linear for small signals only: inside the boundary layer")
    if learns(experiment):
        notes.append("without what is learned from period to period")
    figures["note"] = "; ".join(notes)
    loop = assemble(parts)
    z = poles(loop)
    largest = float(np.abs(z).max(initial=0.0))
    figures |= {
        "stable": largest < 1.0 + ROUNDING,
        "largest_pole": largest,
        "poles": [[float(p.real), float(p.imag)] for p in z],
        "noise_to_voltage_V_per_nm": loop.F * NM,
        "noise_nm": noise_nm,
    }
    if not figures["stable"]:
        return figures
    cut = limits(lambda gain: radius(loop.closed(gain)))
    actuator = limits(lambda gain: radius(assemble(parts, gain).closed()))
    of_1_nm = noise(loop)
    smaller, at = min(factor(*cut), factor(*actuator)), crossings(loop)
    return figures | {
        "gain_margin": smaller if smaller < math.inf else None,
        "gain_margin_lower": cut[0],
        "gain_margin_upper": cut[1],
        "delay_margin_samples": delay_margin(at),
        "phase_margin_deg": phase_margin(at),
        "modulus_margin": modulus_margin(loop),
        "actuator_gain_lower": actuator[0],
        "actuator_gain_upper": actuator[1],
        "noise_floor_nm": of_1_nm["floor_nm"] * noise_nm,
        "voltage_noise_V": of_1_nm["voltage_V"] * noise_nm,
        "voltage_step_noise_V": of_1_nm["step_V"] * noise_nm,
    }


def stepped(experiment: Experiment, figures: dict[str, object]) -> dict[str, Any]:
    """The figures with what raw steps leave, on the plant as given and on others near it.

    `comes_to_rest` is None for a loop that is unstable anyway; `oscillates` has a line for each
    plant on which the loop does not come to rest.
    """
    if figures["linear"] and not figures["stable"]:
        return figures | {"comes_to_rest": None, "oscillates": {}}
    left = {name: seen for name, seen in looks(experiment).items() if seen}
    told = {name: {"step_um": o.step_um, "rms_nm": o.rms_nm} for name, o in left.items()}
    return figures | {"comes_to_rest": not left, "oscillates": told}


def rows(figures: dict[str, Any]) -> list[tuple[str, str, str]]:
    """What `check` found as lines of a table: name, value, unit."""

    def number(value: object, none: str = "-") -> str:
        return none if value is None else f"{value:.4g}"

    def between(name: str) -> str:
        lower, upper = figures[f"{name}_lower"], figures[f"{name}_upper"]
        return f"{number(lower) if lower else 'below 0.01'} to {number(upper, 'above 100')}"

    found = [("controller", figures["controller"], ""), ("observer", figures["observer"], "")]
    if figures["linear"]:
        stable = figures["stable"]
        found.append(("stable on the nominal plant", "yes" if stable else "NO", ""))
        found.append(("largest pole |z|", number(figures["largest_pole"]), ""))
        poles = [
            f"{re:.4f}" + (f" +- {abs(im):.4f}j" if abs(im) > 5e-5 else "")
            for re, im in (np.array(figures["poles"]).round(5) + 0.0).tolist()
        ]
        found.append(("closed-loop poles", "  ".join(dict.fromkeys(poles)), ""))
        if stable:
            delay = figures["delay_margin_samples"]
            found += [
                ("gain margin at the command", between("gain_margin"), "of its own"),
                ("gain margin at the actuator", between("actuator_gain"), "of its own"),
                ("gain margin", number(figures["gain_margin"], "above 100"), "smaller of both"),
                ("delay margin", number(delay, "any delay"), "samples"),
                ("phase margin", number(figures["phase_margin_deg"], "any phase"), "deg"),
                ("modulus margin", number(figures["modulus_margin"]), ""),
                ("noise of y in x1", number(figures["noise_floor_nm"]), "nm rms"),
                ("noise of y in u", number(figures["voltage_noise_V"]), "V rms"),
                ("noise of y in a step of u", number(figures["voltage_step_noise_V"]), "V rms"),
            ]
        gain = figures["noise_to_voltage_V_per_nm"]
        found.append(("noise to voltage within the sample", number(gain), "V/nm"))
    for name, value in (figures["equivalent_pid"] or {}).items():
        gain_name, unit = name[: name.index("_V_")], name[name.index("_V_") + 1 :]
        unit = unit.replace("_per_", "/").replace("um_s", "(um s)").replace("_", " ")
        found.append(
            (f"equivalent PID + D^2: {gain_name}", number(value), unit.replace("s2", "s^2"))
        )
    if figures.get("comes_to_rest") is not None:
        rests = "yes" if figures["comes_to_rest"] else "NO"
        found.append(("comes to rest after raw steps", rests, ""))
        for plant, seen in figures["oscillates"].items():
            after = f"{seen['rms_nm']:.3g} nm rms after {seen['step_um']:.3g} um"
            found.append((f"oscillates, plant {plant}", after, ""))
    met = figures["matching"]
    found.append(("matching condition, continuous", "met" if met["continuous"] else "not met", ""))
    found.append(("matching condition, sampled", "met" if met["sampled"] else "not met", ""))
    return found


def refuse(experiment: Experiment) -> None:
    """Refuse a loop that is unstable, or that does not hold a raw step through its slew limit.

    Raises
    ------
    ParameterError
        See `refuse_unstable` and `refuse_steps`.
    """
    refuse_unstable(experiment)
    refuse_steps(experiment)


def refuse_unstable(experiment: Experiment) -> None:
    """Refuse a loop that is unstable on the nominal plant; nonlinear ones pass.

    Raises
    ------
    ParameterError
        A pole is outside the unit circle; the text says by how much.
    """
    try:
        loop = assemble(blocks(experiment))
    except Nonlinear:
        return
    largest = float(np.abs(poles(loop)).max(initial=0.0))
    refuse_pole(called(experiment), experiment.T_s, largest, "plant")


def refuse_pole(name: str, T_s: float, largest: float, what: str) -> None:
    """Refuse a loop by the size of its largest pole on the nominal plant, or stage.

    Raises
    ------
    ParameterError
        It is outside the unit circle; the text says by how much.
    """
    if largest < 1.0 + ROUNDING:
        return
    grows = T_s / math.log(largest) * 1e3
    raise ParameterError(
        f"{name}: unstable on the nominal {what}: largest closed-loop pole |z| = "
        f"{largest:.4g}, must be below 1 (an error grows e-fold in {grows:.3g} ms); "
        "see pea check, or run it all the same with --force"
    )
