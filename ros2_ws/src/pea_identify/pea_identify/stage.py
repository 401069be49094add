"""A stage from its records: V, F_c, H and the sensor, each with what determines it.

The order: V from fast motion; F_c from a step, once V has died away; V again without the creep;
H from slow motion, through F_c and the delay; where H bends the fast motion, V again from the
output of H. What no record determines is reported in a sentence, not guessed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pea_core.params import ParameterError
from pea_identify import creep as creeps
from pea_identify import frequency_response as responses
from pea_identify import hysteresis, mode_fit, noise, slow
from pea_identify import modes as vibration
from pea_identify.creep import Creep
from pea_identify.frequency_response import FrequencyResponse
from pea_identify.hysteresis import HysteresisFit
from pea_identify.identified_stage import IdentifiedStage, slow_delay
from pea_identify.modes import Modes
from pea_identify.noise import NoiseFit
from pea_identify.records import Part, Periods, Record, grouped, parts_of

LINES = 1500
"""Most frequencies of a non-periodic record that a fit uses."""

SETTLED_S = 0.02
"""Settling time (s) assumed after a step where V is not known."""

LEAST_CREEP = 5e-4
"""Share of the displacement below which creep is left out."""

SURE = 4.0
"""Creep counts if it exceeds so many times the error of the averages."""

CORRECTED = 2
"""How often creep is corrected on slow motion and H fitted again."""

DOUBTFUL = 0.5
"""Error of V on data not fitted, relative to the response, from which on a sentence warns."""

WEAK = 0.02
"""Share of the gain below which a mode is not relied on."""


def identify(
    records: Sequence[Record],
    most_modes: int = 6,
    hysteresis_types: tuple[str, ...] = (),
    hold: str = vibration.HOLDS[0],
) -> IdentifiedStage:
    """Identify a stage with one voltage and one displacement.

    Parameters
    ----------
    records : sequence of Record
        Any number of each kind; see `pea_identify.records`.
    most_modes : int
        Largest count of modes tried.
    hysteresis_types : tuple of str
        Models of H to compare; all where it is empty.
    hold : str
        What lies between the samples of u: ``zero_order`` or ``band_limited``.

    Raises
    ------
    ParameterError
        No record, several axes, different sample periods, or data that determine nothing.
    """
    by_kind = sorted_out(records)
    sentences: list[str] = []
    T_s = (by_kind["periodic"] + by_kind["general"] or records)[0].T_s
    fast = of_fast(by_kind["periodic"], by_kind["general"], T_s, most_modes, hold, sentences)
    F_c = of_steps(by_kind["step"], fast.modes, T_s, sentences)
    modes = refitted(fast, F_c, sentences)

    H: HysteresisFit | None = None
    tried: list[HysteresisFit] = []
    if by_kind["slow"]:
        H, tried = of_slow(by_kind["slow"], modes, F_c, hysteresis_types)
    else:
        sentences.append("Hysteresis is not determined: no record with slow motion (triangles).")

    bent = modes
    if modes is not None and H is not None and H.type != "none" and fast.groups:
        bent = behind(by_kind["periodic"], H, F_c, modes)
    through_H = bent is not modes
    slope = H.slope if through_H and H is not None else 1.0
    small, small_95 = math.nan, math.nan
    if bent is not None:
        small, small_95 = (float(each[0, 0]) * slope for each in (bent.gain, bent.gain_95))
    return IdentifiedStage(
        records=tuple(records),
        T_s=T_s,
        response=fast.response,
        modes=bent,
        through_H=through_H,
        small=small,
        small_95=small_95,
        amplitudes=fast.amplitudes,
        creep=F_c if F_c is not None and len(F_c.tau) else None,
        hysteresis=H,
        tried=tuple(tried),
        noise=of_noise(by_kind["rest"], fast.groups, sentences),
        sentences=tuple(sentences),
    )


def sorted_out(records: Sequence[Record]) -> dict[str, list[Record]]:
    """Records by their kind.

    Raises
    ------
    ParameterError
        No record, several axes, or fast records of different sample periods.
    """
    if not records:
        raise ParameterError("no record: give at least one")
    for r in records:
        if r.u.shape[1] > 1 or r.y.shape[1] > 1:
            raise ParameterError(
                f"{r.name}: {r.u.shape[1]} voltages and {r.y.shape[1]} displacements: one axis "
                "each here; identify_axes takes several"
            )
    by_kind = {kind: [r for r in records if r.kind == kind] for kind in _KINDS}
    fast = by_kind["periodic"] + by_kind["general"]
    if len({f"{r.T_s:.9g}" for r in fast}) > 1:
        raise ParameterError(
            "sample periods of {} s: fast records need one".format(
                " and ".join(sorted({f"{r.T_s:g}" for r in fast}))
            )
        )
    return by_kind


class FastMotion(NamedTuple):
    """V from fast motion alone.

    groups : periods of one amplitude each, rising; empty where no record is periodic.
    response, modes : at the smallest amplitude; None without a fast record.
    amplitudes : rms voltage (V) and V at each.
    """

    groups: list[Periods]
    response: FrequencyResponse | None
    modes: Modes | None
    amplitudes: tuple[tuple[float, Modes], ...]


def of_fast(
    periodic: Sequence[Record],
    general: Sequence[Record],
    T_s: float,
    most: int,
    hold: str,
    sentences: list[str],
) -> FastMotion:
    """V from periodic records, at each amplitude; from another fast record where none is."""
    groups = grouped([part for r in periodic for part in parts_of(r)], T_s)
    lines = {r.lines for r in periodic}
    if len(lines) == 1:
        groups = [group._replace(lines=next(iter(lines))) for group in groups]
    groups.sort(key=lambda group: group.rms)
    found = [of_periods(group, most, hold, sentences) for group in groups]
    levels = [group.rms for group in groups]
    if not found and general:
        found = [of_records(general, most, hold)]
        levels = [float(general[0].u.std())]
    if not found:
        sentences.append(
            "V is not determined: no record with fast motion (a multisine, a chirp, noise)."
        )
        return FastMotion(groups, None, None, ())
    response, modes = found[0]
    if modes.error > DOUBTFUL:
        sentences.append(
            f"V is doubtful: at frequencies that were not fitted it is off by {modes.error:.0%} of "
            "the response. Either noise covers the response, or u is not the voltage that moved y; "
            "where both were measured at the same instants, give --hold band_limited."
        )
    amplitudes = tuple((rms, fitted) for rms, (_, fitted) in zip(levels, found, strict=True))
    return FastMotion(groups, response, modes, amplitudes)


def refitted(fast: FastMotion, F_c: Creep | None, sentences: list[str]) -> Modes | None:
    """V once more, without the creep and with the lag of an amplifier where one shows."""
    response, modes = fast.response, fast.modes
    if modes is None or response is None or not fast.groups:
        return modes
    extras = mode_fit.extras_of(response)
    if modes.corner:
        extras = (*extras, "corner")
    if F_c is not None and len(F_c.tau):
        response = without(response, F_c)
        if not modes.corner:  # a corner inside the band belongs to H, not to F_c
            extras = tuple(name for name in extras if name != "creep")
        modes = mode_fit.refined(modes, response, extras)
    return with_lag(modes, response, extras, sentences)


def of_steps(
    records: Sequence[Record], modes: Modes | None, T_s: float, sentences: list[str]
) -> Creep | None:
    """Creep after the step with the longest hold; what it does not determine is reported."""
    if not records:
        sentences.append("Creep is not determined: no record of a step with a long hold.")
        return None
    longest = max(records, key=lambda r: r.duration)
    rings = SETTLED_S if modes is None else settling(modes, longest)
    F_c = creeps.identify(longest, max(rings, 20.0 * T_s))
    # the hold does not determine the weight of an operator much slower than itself
    if F_c.grown < max(SURE * F_c.doubt, LEAST_CREEP):
        none = np.empty(0)
        F_c = replace(F_c, tau=none, weights=none, tau_95=none, weights_95=none)
    if not len(F_c.tau):
        sentences.append("Creep is below what the step record shows.")
    if F_c.duration < 10.0:
        sentences.append(
            f"Creep slower than {F_c.duration:.3g} s is not determined: the step record ends there."
        )
    return F_c


def behind(records: Sequence[Record], H: HysteresisFit, F_c: Creep | None, modes: Modes) -> Modes:
    """Modes fitted to the output of H; `modes` where that is no better."""
    try:
        bent, gained = from_H(records, H, F_c, modes)
    except ParameterError:  # the amplitude moves no play operator
        return modes
    enough = 0.5 if "prandtl" in H.type else 1.1
    return bent if gained < enough and near(bent, modes) else modes


_KINDS = ("periodic", "general", "slow", "step", "rest")


def settling(modes: Modes, r: Record) -> float:
    """Time (s) after the move of a step from which V has forgotten all but 1e-4 of it.

    A soft move leaves less to forget than a jump.
    """
    if f"{r.T_s:.9g}" != f"{modes.T_s:.9g}":
        strong = modes.shares >= 0.001
        return modes.delay + float((9.2 / (modes.zeta * modes.omega_n))[strong].max())
    u = r.u - r.u[0]
    _, last, end = creeps.hold_of(u[:, 0])
    if end < len(u):  # V lags behind a return to rest, too
        u[last:] = np.median(u[last:end], axis=0)
    unit = replace(modes, K=modes.K / modes.gain)
    ringing = np.abs(unit.simulate(u)[:, 0] - u[:, 0])[last:end]
    left = np.flatnonzero(ringing > 1e-4 * np.ptp(u))
    return (int(left[-1]) + 1) * r.T_s if len(left) else 0.0


def of_periods(
    group: Periods, most: int, hold: str, sentences: list[str]
) -> tuple[FrequencyResponse, Modes]:
    """Response and V of periods; some realisations, or every other line, are held out."""
    u, y, T_s = group.u, group.y, group.T_s
    said = np.array(group.lines, dtype=int) if group.lines else None
    whole = responses.from_periods(u, y, T_s, said)
    R = u.shape[2]
    if R >= 3:
        held = max(1, R // 3)
        lines = np.round(whole.f * len(u) * T_s).astype(int)
        fitted = responses.from_periods(u[:, :, :-held], y[:, :, :-held], T_s, lines)
        apart = responses.from_periods(u[:, :, -held:], y[:, :, -held:], T_s, lines)
    else:
        sentences.append(
            f"{group.name}: {R} realisation{'s' * (R > 1)}: what is nonlinear shows from three "
            "on; every fifth line is held out instead."
        )
        odd = np.arange(len(whole.f)) % 5 == 2
        fitted, apart = whole.at(~odd), whole.at(odd)
    modes = mode_fit.fit(fitted, apart, most, hold, whole=whole)
    return whole, modes


def of_records(records: Sequence[Record], most: int, hold: str) -> tuple[FrequencyResponse, Modes]:
    """Response and V of the longest record that is not periodic; every fifth line is held out."""
    r = max(records, key=lambda r: r.duration)
    u, y = r.u[:, 0], r.y[:, 0]
    U, Y = np.fft.rfft(u - u.mean()), np.fft.rfft(y - y.mean())
    f = np.arange(len(U)) / (len(u) * r.T_s)
    size = np.abs(U)
    level = np.sqrt(np.convolve(size**2, np.ones(31) / 31.0, mode="same"))
    use = (f > 0.0) & (level > 1e-3 * level[1:].max()) & (size > 0.1 * level) & (f < 0.49 / r.T_s)
    lines = np.flatnonzero(use)
    if len(lines) < 64:
        raise ParameterError(
            f"{r.name}: {len(lines)} frequencies are excited: V needs a multisine, a chirp or "
            "noise over the band of the resonances"
        )
    lines = lines[:: math.ceil(len(lines) / LINES)]
    U, f = U[lines], f[lines]
    G = (Y[lines] / U)[:, None, None]
    variance = np.full(G.shape, float(np.median(np.abs(Y[lines])) ** 2 * 1e-4))
    variance = variance / (np.abs(U) ** 2)[:, None, None]
    nan = np.full(G.shape, np.nan)
    modes = None
    for _ in range(2):  # the second pass weights by the noise that the first has found
        made = FrequencyResponse(f, G, variance, nan, np.full((len(f), 1), np.nan), r.T_s)
        odd = np.arange(len(f)) % 5 == 2
        parts = (made.at(~odd), made.at(odd), made)
        spectra = (U[~odd], U[odd], U)
        modes = mode_fit.fit(parts[0], parts[1], most, hold, extras=(), whole=made, spectra=spectra)
        problem = vibration.ModesProblem(made, np.ones(G.shape), hold, (), U)
        x = np.concatenate([np.log(modes.omega_n), np.log(modes.zeta), [modes.delay / modes.T_s]])
        weighted = vibration.ModesProblem(made, vibration.deviation_of(made), hold, (), U)
        K = weighted.gains(weighted.columns(x))
        left = problem.left(x, K).reshape(2, -1)
        power = (left**2).sum(axis=0) * np.abs(U) ** 2
        width = min(101, len(power) // 4 * 2 + 1)
        smooth = np.convolve(np.pad(power, width // 2, mode="reflect"), np.ones(width), "valid")
        variance = (smooth / width / np.abs(U) ** 2)[:, None, None]
    assert modes is not None
    coarse = responses.from_record(u, y, r.T_s)
    return coarse, modes


def without(response: FrequencyResponse, F_c: Creep) -> FrequencyResponse:
    """A response without the creep in front of V."""
    factor = F_c.response(response.f)[:, None, None]
    size = np.abs(factor) ** 2
    return replace(
        response,
        G=response.G / factor,
        noise=response.noise / size,
        total=response.total / size,
    )


def with_lag(
    modes: Modes, response: FrequencyResponse, extras: tuple[str, ...], sentences: list[str]
) -> Modes:
    """V with the lag of an amplifier, where that explains the response clearly better."""
    try:
        lagged = mode_fit.refined(modes, response, (*extras, "lag"))
    except (ValueError, np.linalg.LinAlgError):
        return modes
    lines = 2.0 * response.G.size
    gained = lines * math.log(max(modes.misfit, 1e-12) / max(lagged.misfit, 1e-12))
    clear = lagged.lag > 2.0 * lagged.lag_95 and gained > 3.0 * math.log(lines) + 9.0
    inside = lagged.lag > 0.05 * modes.T_s and 1.0 / lagged.lag > 2.0 * math.pi * response.f[0]
    if clear and inside and np.allclose(lagged.omega_n, modes.omega_n, rtol=0.05):
        return lagged
    sentences.append(
        "The amplifier's bandwidth is not determined: its lag cannot be distinguished from the "
        "delay in this band."
    )
    return modes


def of_slow(
    records: Sequence[Record],
    modes: Modes | None,
    F_c: Creep | None,
    types: tuple[str, ...],
) -> tuple[HysteresisFit, list[HysteresisFit]]:
    """H, chosen on the last third of each record and then fitted to all of it."""
    delay = slow_delay(modes) if modes is not None else 0.0
    tau = F_c.tau if F_c is not None else np.empty(0)
    weights = F_c.weights if F_c is not None else np.empty(0)
    chosen, tried = hysteresis.choose(
        slow.prepared(records, delay, tau, weights, hold_out=True), types
    )
    data = slow.prepared(records, delay, tau, weights, hold_out=False)
    again = hysteresis.again(chosen, data)
    for _ in range(CORRECTED if len(tau) and not len(again.slopes) else 0):
        again = hysteresis.again(again, hysteresis.without_creep(data, again))
    return replace(again, held_out=chosen.held_out), tried


def from_H(
    records: Sequence[Record], H: HysteresisFit, F_c: Creep | None, modes: Modes
) -> tuple[Modes, float]:
    """V from the output of H along the fast voltages, at the smallest amplitude.

    Besides, what is left of the variance of the response when u goes through H first: small
    where H makes the difference between realisations.
    """
    parts: list[Part] = []
    plain: list[Part] = []
    for r in records:
        parts += parts_of(r, H.voltage(r.u[:, 0])[:, None])
        plain += parts_of(r)
    pairs = zip(grouped(parts, modes.T_s, plain), grouped(plain, modes.T_s), strict=True)
    group, straight = min(pairs, key=lambda pair: pair[1].rms)
    u, y = straight.u, straight.y
    given = {r.lines for r in records}
    said = np.array(next(iter(given)), dtype=int) if len(given) == 1 and given != {()} else None
    before = responses.from_periods(u, y, modes.T_s, said)
    lines = np.round(before.f * len(u) * modes.T_s).astype(int)
    response = responses.from_periods(group.u, group.y, modes.T_s, lines)
    extras = ["creep"] if response.f[0] < vibration.CREEP_BELOW else []
    share = response.variance / np.abs(response.G) ** 2
    share_before = before.variance / np.abs(before.G) ** 2
    gained = float(np.median(share) / max(float(np.median(share_before)), 1e-300))
    if F_c is not None and len(F_c.tau):
        response, extras = without(response, F_c), []
    if modes.lag:
        extras.append("lag")
    return mode_fit.refined(modes, response, tuple(extras)), gained


def near(one: Modes, other: Modes) -> bool:
    """Whether two fits of one stage nearly agree, so that neither has failed."""
    strong = other.shares >= WEAK
    apart = np.abs(one.omega_n / other.omega_n - 1.0)[strong].max()
    return bool(apart < 0.1 and abs(one.delay - other.delay) < 0.2 * other.T_s)


def of_noise(
    rests: Sequence[Record], groups: Sequence[Periods], sentences: list[str]
) -> NoiseFit | None:
    """Sensor noise from the longest record at rest, or from what differs between periods."""
    if rests:
        return noise.at_rest(max(rests, key=lambda r: r.duration).y[:, 0])
    for group in groups:
        if group.y.shape[-1] >= 2:
            return noise.between_periods(group.y[:, 0])
    sentences.append("Sensor noise is not determined: no record at rest, and none of two periods.")
    return None
