"""Fits V to a frequency response: number of modes, first guesses, confidence intervals."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pea_core.params import ParameterError
from pea_identify.frequency_response import FrequencyResponse
from pea_identify.intervals import Z_95
from pea_identify.modes import CREEP_BELOW, EXTRAS, HOLDS, Modes, ModesProblem, deviation_of
from pea_identify.peaks import Peak, resonances


def first_guesses(problem: ModesProblem, omega: np.ndarray) -> list[np.ndarray]:
    """First guesses of one mode: at the peak and elsewhere, with several dampings and delays."""
    peak = float(omega[np.argmax(np.abs(problem.G).max(axis=1))])
    tails = [EXTRAS[name][2] for name in problem.extras]
    guesses = []
    places = {peak, float(omega[len(omega) // 2]), *np.geomspace(omega[0] * 3.0, omega[-1], 5)}
    for omega_n in places:
        for zeta in (0.01, 0.1, 0.6):
            for delay in np.arange(0.0, 16.0, 1.5):
                x = np.array([math.log(omega_n), math.log(zeta), delay, *tails])
                guesses.append((float(np.sum(problem.left(x) ** 2)), x))
    guesses.sort(key=lambda pair: pair[0])
    return [x for _, x in guesses[:4]]


def with_another(problem: ModesProblem, x: np.ndarray, omega: np.ndarray) -> list[np.ndarray]:
    """First guesses with one more mode than x: at the largest error and elsewhere."""
    n = problem.count(x)
    error = problem.left(x).reshape(2, -1, len(omega))
    power = (error**2).sum(axis=(0, 1))
    width = max(3, len(omega) // 100)
    smooth = np.convolve(power, np.ones(width) / width, mode="same")
    places = {float(omega[np.argmax(smooth)]), float(omega[-1]) * 1.3}
    places |= {float(o) for o in np.geomspace(omega[0] * 3.0, omega[-1], 6)}
    guesses = []
    for omega_n in places:
        for zeta in (0.01, 0.1, 0.5):
            more = np.concatenate(
                [x[:n], [math.log(omega_n)], x[n : 2 * n], [math.log(zeta)], x[2 * n :]]
            )
            guesses.append((float(np.sum(problem.left(more) ** 2)), more))
    guesses.sort(key=lambda pair: pair[0])
    return [more for _, more in guesses[:3]]


def at_peaks(problem: ModesProblem, peaks: list[Peak]) -> np.ndarray:
    """First guess with one mode at each peak, and the delay with the smallest error."""
    tails = [EXTRAS[name][2] for name in problem.extras]
    shape = [math.log(peak.omega_n) for peak in peaks] + [math.log(peak.zeta) for peak in peaks]
    guesses = [np.array([*shape, delay, *tails]) for delay in np.arange(0.0, 16.0, 0.5)]
    return min(guesses, key=lambda x: float(np.sum(problem.left(x) ** 2)))


def extras_of(response: FrequencyResponse) -> tuple[str, ...]:
    """Factors to fit to a response.

    Creep, if the lowest line is low enough to show it; loss, if hysteresis or another nonlinearity
    is larger than the noise.
    """
    extras = ["creep"] if response.f[0] < CREEP_BELOW else []
    ratio = response.total / np.maximum(response.noise, 1e-300)
    if np.isfinite(ratio).all() and np.median(ratio) > 3.0:
        extras.append("loss")
    return tuple(extras)


class CountTrial(NamedTuple):
    """The solution x for one number of modes, and its score with standard error."""

    problem: ModesProblem
    check: ModesProblem | None
    x: np.ndarray
    score: float
    deviation: float


def counted(
    problem: ModesProblem, check: ModesProblem | None, most: int, omega: np.ndarray
) -> list[CountTrial]:
    """A trial for each number of modes, from 1 until more modes no longer improve the score."""
    starts = first_guesses(problem, omega)
    peaks = resonances(problem.f, problem.G)
    tried: list[CountTrial] = []
    for n in range(1, most + 1):
        if n <= len(peaks):
            starts.append(at_peaks(problem, peaks[:n]))
        solutions = [problem.solve(x) for x in starts]
        x, cost = min(solutions, key=lambda pair: pair[1])
        tried.append(CountTrial(problem, check, x, *scored(problem, check, x, cost)))
        scores = [trial.score for trial in tried[-3:]]
        if len(scores) > 2 and scores[2] > scores[1] >= scores[0] * 0.999:
            break
        if 2 * (n + 1) * 3 > len(omega):
            break
        starts = with_another(problem, x, omega)
    return tried


def fit(
    response: FrequencyResponse,
    held_out: FrequencyResponse | None = None,
    most: int = 6,
    hold: str = HOLDS[0],
    extras: tuple[str, ...] | None = None,
    whole: FrequencyResponse | None = None,
    spectra: tuple[np.ndarray, ...] = (),
) -> Modes:
    """Identify V.

    Parameters
    ----------
    response : FrequencyResponse
        Of the stage, small amplitude.
    held_out : FrequencyResponse, optional
        At the same lines, from other experiments: it decides the number of modes. Without it,
        Schwarz's criterion decides.
    most : int
        Largest number of modes to try.
    hold : str
        How u behaves between samples: one of `HOLDS`.
    extras : tuple of str, optional
        Factors of `EXTRAS` to fit; default: those of `extras_of`.
    whole : FrequencyResponse, optional
        Of all data: the final fit, with the chosen number of modes, uses it.
    spectra : tuple of (F,) array
        Spectrum of the voltage for each of response, held_out, whole, if the record is not
        periodic.

    Raises
    ------
    ParameterError
        Too few lines.
    """
    if len(response.f) < 8:
        lines = len(response.f)
        raise ParameterError(
            f"{lines} line{'s are' if lines != 1 else ' is'} too few for a mode: excite at least 8 "
            "frequencies"
        )
    omega = 2.0 * math.pi * response.f
    extras = extras_of(response) if extras is None else extras
    given = (*spectra, None, None, None)
    trials: list[CountTrial] = []
    for names in (extras, (*extras, "corner")) if "creep" in extras else (extras,):
        problem = ModesProblem(response, deviation_of(response), hold, names, given[0])
        check = None
        if held_out is not None:
            check = ModesProblem(held_out, deviation_of(held_out), hold, names, given[1])
        trials += counted(problem, check, most, omega)
    best = min(trials, key=lambda trial: trial.score)
    within = [trial for trial in trials if trial.score <= best.score + best.deviation]
    chosen = min(within, key=lambda trial: trial.problem.unknowns(trial.x))
    problem, check, x = chosen.problem, chosen.check, chosen.x
    extras = problem.extras
    counts = tuple(
        (problem.count(trial.x), trial.score) for trial in trials if trial.problem is problem
    )
    apart = math.nan
    if check is not None:
        gap = check.columns(x) @ problem.gains(problem.columns(x)) - check.G
        apart = float(np.sqrt(np.mean(np.abs(gap) ** 2) / np.mean(np.abs(check.G) ** 2)))
    if whole is not None:
        problem = ModesProblem(whole, deviation_of(whole), hold, extras, given[2])
        x = problem.solve(x)[0]
    return replace(intervals(problem, x), error=apart, tried=counts)


def refined(modes: Modes, response: FrequencyResponse, extras: tuple[str, ...]) -> Modes:
    """The same number of modes, fitted to another response from the present values on."""
    problem = ModesProblem(response, deviation_of(response), modes.hold, extras)
    first = {
        "creep": modes.creep if ("corner" in extras) == bool(modes.corner) else 0.0,
        "corner": modes.corner,
        "loss": modes.loss,
        "lag": modes.lag / modes.T_s or 0.5,
    }
    x = np.concatenate(
        [
            np.log(modes.omega_n),
            np.log(modes.zeta),
            [modes.delay / modes.T_s],
            [first[name] for name in extras],
        ]
    )
    x, _ = problem.solve(x)
    return replace(intervals(problem, x), error=modes.error, tried=modes.tried)


def scored(
    problem: ModesProblem, check: ModesProblem | None, x: np.ndarray, cost: float
) -> tuple[float, float]:
    """Score of the unknowns x, lower is better, and its standard error."""
    size = problem.G.size
    if check is None:
        return 2.0 * size * math.log(cost) + problem.unknowns(x) * math.log(2.0 * size), 0.0
    left = check.left(x, problem.gains(problem.columns(x)))
    squares = (left.reshape(2, -1) ** 2).sum(axis=0)
    return float(squares.mean()), float(squares.std() / math.sqrt(size))


def intervals(problem: ModesProblem, x: np.ndarray) -> Modes:
    """The modes of x, with 95 % intervals."""
    n = problem.count(x)
    order = np.argsort(x[:n])
    x = np.concatenate([x[:n][order], x[n : 2 * n][order], x[2 * n :]])
    omega_n, zeta, factors = problem.split(x)
    K = problem.gains(problem.columns(x))  # of a record, with the transients
    whole = np.concatenate([x, K.ravel()])

    def left(theta: np.ndarray) -> np.ndarray:
        return problem.left(theta[: len(x)], theta[len(x) :].reshape(K.shape))

    J = np.empty((2 * problem.G.size, len(whole)))
    steps = 1e-6 * np.maximum(
        np.abs(whole), np.concatenate([np.ones(len(x)), np.abs(K).max() * np.ones(K.size)])
    )
    for i, step in enumerate(steps):
        theta = whole.copy()
        theta[i] += step
        above = left(theta)
        theta[i] -= 2.0 * step
        J[:, i] = (above - left(theta)) / (2.0 * step)
    free = 2 * problem.G.size - len(whole)
    misfit = float(np.sum(left(whole) ** 2) / free * 2.0)
    # without noise, a surplus mode may have no effect on the residual: a column of zeros
    scale = np.maximum(np.linalg.norm(J, axis=0), 1e-150)
    scaled = J / scale
    bread = np.linalg.pinv(scaled.T @ scaled)
    # the variance of each line comes from its residual, so the weights need not be exact
    moved = (np.abs(left(whole)) * math.sqrt(len(J) / free))[:, None] * scaled @ bread / scale
    half = Z_95 * np.linalg.norm(moved, axis=0)
    gains = moved[:, len(x) : len(x) + n * K.shape[1]].reshape(len(J), n, K.shape[1])
    gain_95 = Z_95 * np.linalg.norm(gains.sum(axis=1), axis=0)
    shape = (n, *problem.shape)
    widths = dict(zip(problem.extras, half[2 * n + 1 : len(x)].tolist(), strict=True))
    return Modes(
        omega_n=omega_n,
        zeta=zeta,
        K=K[:n].reshape(shape),
        delay=factors.delay,
        creep=factors.creep,
        loss=factors.loss,
        lag=factors.lag,
        corner=factors.corner,
        omega_n_95=half[:n] * omega_n,
        zeta_95=half[n : 2 * n] * zeta,
        K_95=half[len(x) : len(x) + n * K.shape[1]].reshape(shape),
        delay_95=float(half[2 * n] * problem.T_s),
        creep_95=widths.get("creep", 0.0),
        loss_95=widths.get("loss", 0.0),
        lag_95=widths.get("lag", 0.0) * problem.T_s,
        gain_95=gain_95.reshape(problem.shape),
        misfit=misfit,
        T_s=problem.T_s,
        hold=problem.hold,
    )
