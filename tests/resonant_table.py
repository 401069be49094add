"""Tables of docs/resonant.md: ``.ci/env python tests/resonant_table.py PART ...``.

nominal
    The presets for resonant stages and for a late sensor on their plants, on three hysteresis
    models, with the inverse of that model where there is such a preset.
set
    Worst of the corners of +-3 % in every frequency with +-10 % in K.
draws
    Closed-loop poles of 500 stages drawn from that set.
margins
    Margins and rejection of the presets on that set, as `pea tune --from-model` judges gains.
bandwidth
    Bandwidth and modulus margin of gains that go for them, measured by injection as `pea measure
    loop --to 4000` does.
steps
    Raw steps of 5 um through slew limits of 40 and 80 V/ms, with every preset on its stage.
shaped
    A step of 5 um on a stage of 1 % damping whose frequency is 5 % off: with a shaper, without,
    and with PID.
learning
    The preset `resonant` on three hysteresis models, without and with learning.
today
    The laws that know one mode only, on the same plants.

Errors are rms of x1 - w over the second half of a run, in nm, at 10, 50 and 100 Hz of 5 sin + 5 um.
"""

from __future__ import annotations

import itertools
import sys

import numpy as np

from pea_core.modal import sampled, varied
from pea_core.params import ParameterError
from pea_experiment import experiments
from pea_lab.proposal import Problem, ProposalGoal
from pea_lab.proposal import SampledStage as Sampled

RUNS = ((10.0, 0.6), (50.0, 0.5), (100.0, 0.5))
"""Frequency (Hz) and length (s) of each run."""

STAGES = {
    "resonant": "resonant_two_modes",
    "resonant_fast": "resonant_two_modes",
    "resonant_pidsmc": "resonant_two_modes",
    "resonant_4": "resonant_two_modes_4",
    "resonant_9": "resonant_two_modes_9",
    "late_4": "sensor_4_late",
    "late_8": "sensor_8_late",
}
FAST: dict[str, dict[str, float]] = {
    "resonant_fast": {},
    "resonant_4": {
        "estimator.eps_rate_walk": 30690.0, "estimator.input_noise": 0.4583, "effort": 1448.0,
    },
    "resonant_9": {
        "estimator.eps_rate_walk": 8570.0, "estimator.input_noise": 0.4754, "effort": 4.852e8,
    },
}  # fmt: skip
"""Gains that go for bandwidth, over those of a preset."""
OMEGA, K = np.array([4643.2741, 12566.3706]), np.array([0.135, 0.007])


def error(sets: list[str], frequency: float, duration: float) -> float:
    """Error (nm rms) of one run."""
    reference = [
        "reference.type=sine",
        "reference.amplitude_um=5",
        "reference.offset_um=5",
        f"reference.frequency_hz={frequency}",
    ]
    # sine_series has the paper's plant, whose modes a plant preset of a late sensor leaves alone
    late = any("sensor_" in one for one in sets)
    name, observer = ("sine_series", ["observer.preset=measured"]) if late else ("resonant", [])
    experiment = experiments.load(name, [*observer, *sets, *reference], duration)
    loop = experiment.loop()
    found = np.empty(experiment.samples)
    for k in range(experiment.samples):
        x1 = loop.plant.truth.x1
        rows = loop.run(1)
        if not len(rows):
            return float("inf")
        found[k] = x1 - rows["w"][0]
    return float(np.sqrt(np.mean(found[experiment.samples // 2 :] ** 2)) * 1e9)


def line(name: str, sets: list[str]) -> None:
    """Print the errors of one case."""
    try:
        told = [f"{error(sets, f, duration):.3g}" for f, duration in RUNS]
    except ParameterError as refused:
        told = [str(refused)]
    print(f"| {name} | {' / '.join(told)} |", flush=True)


def nominal() -> None:
    """Every preset on its stage."""
    known = experiments.presets("controller")
    for law, plant in STAGES.items():
        for hysteresis in ("prandtl_ishlinskii", "preisach", "bouc_wen"):
            own = f"{law}_{hysteresis}" if f"{law}_{hysteresis}" in known else law
            sets = [f"plant.preset={plant}", f"controller.preset={own}"]
            line(f"{own}, {hysteresis}", [*sets, f"plant.hysteresis.type={hysteresis}"])


def corners() -> None:
    """The corners of the set."""
    for law in ("resonant", "resonant_4", "resonant_9"):
        for first, second, gain in itertools.product((-1, 1), repeat=3):
            omega = OMEGA * (1.0 + 0.03 * np.array([first, second]))
            sets = [
                f"plant.preset={STAGES[law]}",
                f"controller.preset={law}",
                f"plant.vibration.omega_n={omega.round(4).tolist()}",
                f"plant.vibration.K={(K * (1.0 + 0.1 * gain)).round(6).tolist()}",
            ]
            line(f"{law}, {3 * first:+d} % {3 * second:+d} %, K {10 * gain:+d} %", sets)


def problem_of(law: str) -> tuple[Problem, dict[str, float]]:
    """The problem that a preset for a resonant stage solves, and its gains."""
    sets = [f"plant.preset={STAGES[law]}", f"controller.preset={law}"]
    loaded = experiments.load("resonant", sets)
    params = loaded.nodes["controller"].params
    gains = {
        "estimator.eps_rate_walk": params.estimator.eps_rate_walk,
        "estimator.input_noise": params.estimator.input_noise,
        "effort": params.effort,
    }
    return Problem(params, ProposalGoal(), loaded.T_s), gains


def margins() -> None:
    """Modulus margins, -3 dB of T, |S V| over the gain on the set."""
    for law in ("resonant", "resonant_4", "resonant_9"):
        problem, gains = problem_of(law)
        found = problem.figures(gains)
        print(
            f"| {law} | {found.modulus:.2f}, {found.modulus_set:.2f} | {found.bandwidth:.0f} Hz"
            f" | {found.resonance:.3g} |",
            flush=True,
        )


def draws() -> None:
    """Largest pole of 500 stages."""
    for law in ("resonant", "resonant_4", "resonant_9"):
        problem, gains = problem_of(law)
        found, T_s = problem.law(gains), problem.T_s
        rng, largest = np.random.default_rng(1), []
        for _ in range(500):
            model = varied(problem.model, 1.0 + rng.uniform(-0.03, 0.03, 2), rng.uniform(0.9, 1.1))
            A = problem.closed(Sampled(model, sampled(model, T_s)), *found)
            largest.append(float(np.abs(np.linalg.eigvals(A)).max()))
        unstable = sum(z >= 1.0 for z in largest)
        print(
            f"| {law} | largest pole {max(largest):.5f}, unstable {unstable} of 500 |", flush=True
        )


def bandwidth() -> None:
    """-3 dB of T and modulus margin by injection, with and without hysteresis."""
    from pea_core.loop import blocks_of, trace
    from pea_measure import analysis, plans

    for law, gains in FAST.items():
        sets = [f"controller.{name}={value}" for name, value in gains.items()]
        for hysteresis in ("none", "prandtl_ishlinskii"):
            on = (f"plant.preset={STAGES[law]}", f"plant.hysteresis.type={hysteresis}")
            base = plans.Base("resonant", (*on, f"controller.preset={law}", *sets))
            made = plans.injected(base, "loop", None, {"to_hz": 4000.0})
            loop = made.experiment.loop()
            samples = trace([loop.run(n) for n in blocks_of(made.experiment.samples, loop.piece)])
            found = analysis.of(made, samples)["margins"]
            told = " | ".join(
                f"{found[name]['measured']:.4g} ({found[name]['low_95']:.4g} to "
                f"{found[name]['high_95']:.4g})"
                for name in ("bandwidth_hz", "modulus")
            )
            print(f"| {law} {gains or ''} | {hysteresis} | {told} |", flush=True)


def stepped(sets: list[str], experiment: str, duration: float) -> np.ndarray | str:
    """x1 (nm) of a run beyond a step to 5 um, or why it is refused before."""
    from pea_lab.check import refuse

    try:
        made = experiments.load(experiment, sets, duration)
        refuse(made)
    except ParameterError as refused:
        return f"refused: {refused}"
    loop = made.loop()
    found = np.empty(made.samples)
    for k in range(made.samples):
        x1 = loop.plant.truth.x1
        rows = loop.run(1)
        if not len(rows):
            return "could not go on"
        found[k] = x1 * 1e9 - 5000.0
    return found


def steps() -> None:
    """What is left of a raw step after 0.3 s, and the overshoot (nm)."""
    paper = ("recommended", "precise", "pid", "paper_set1", "paper_set2", "disturbance_observer",
             "smc", "smc_boundary_layer", "open_loop")  # fmt: skip
    of: dict[str, list[str]] = {
        law: ["plant.preset=hysteresis_creep_noise_delay", "observer.preset=extended_state"]
        for law in paper
    }
    for law, plant in STAGES.items():
        of[law] = [f"plant.preset={plant}", "observer.preset=measured"]
        for kind in ("preisach", "bouc_wen"):
            if (own := f"{law}_{kind}") in experiments.presets("controller"):
                of[own] = [*of[law], f"plant.hysteresis.type={kind}"]
    reference = ["reference.type=step", "reference.shape=raw", "reference.offset_um=0",
                 "reference.amplitude_um=5", "reference.time=0.002"]  # fmt: skip
    for law, sets in of.items():
        told = []
        for slew in (40e3, 80e3):
            chosen = "type" if law == "open_loop" else "preset"
            more_sets = [f"controller.{chosen}={law}", f"plant.amplifier.slew_rate={slew:g}"]
            e = stepped([*sets, *more_sets, *reference], "sine_series", 0.35)
            left = e if isinstance(e, str) else f"{np.abs(e[6040:]).max():.3g}; {e.max():.0f}"
            told.append(left)
        print(f"| {law} | {' | '.join(told)} |", flush=True)


def shaped() -> None:
    """Largest error 1.5 periods and 10 ms after a step of 5 um, the mode right and 5 % off."""
    pid = ["controller.preset=pid", "controller.K_p=0", "controller.K_d=0", "controller.K_i=300"]
    raw = ["reference.shaper.type=none", "reference.shape=raw"]
    cases = {
        "`recommended`, none": raw,
        **{f"`recommended`, `{n}`": [f"reference.shaper.type={n}"] for n in ("zv", "zvd")},
        "PID, none": [*raw, *pid],
        "PID, `zv`": pid,
    }
    for name, sets in cases.items():
        told = []
        for off in (1.0, 1.05, 0.95):
            stage = [f"plant.omega_n={4643.274 * off:.7g}", "plant.sensor.noise_nm=0"]
            e = stepped([*stage, *sets], "shaped_step", 0.05)
            if isinstance(e, str):
                told.append(e)
                continue
            e = np.abs(e[200:])  # the step is at 10 ms
            period = 2.0 * np.pi / 4643.274
            after = [e[round(t / 50e-6) :].max() for t in (1.5 * period, 10e-3)]
            told.append(f"{after[0]:.3g}; {after[1]:.2g}")
        print(f"| {name} | {' | '.join(told)} |", flush=True)


def learning() -> None:
    """From the 30th period of 100 Hz on, without and with learning."""
    for hysteresis in ("prandtl_ishlinskii", "preisach", "bouc_wen"):
        sets = ["plant.preset=resonant_two_modes", f"plant.hysteresis.type={hysteresis}"]
        on = ["controller.learning.method=iterative", "controller.learning.rate=1.0",
              "controller.learning.spread_frequency=0.005"]  # fmt: skip
        told = [f"{error([*sets, *more], 100.0, 0.6):.3g}" for more in ([], on)]
        print(f"| {hysteresis} | {' | '.join(told)} |", flush=True)


def today() -> None:
    """Laws of one mode on the same stages."""
    for plant in dict.fromkeys(STAGES.values()):
        for law in ("recommended", "precise", "pid"):
            sets = [f"plant.preset={plant}", f"controller.preset={law}",
                    "observer.preset=extended_state"]  # fmt: skip
            line(f"{law} on {plant}", sets)


if __name__ == "__main__":
    parts = {
        "nominal": nominal, "set": corners, "draws": draws, "margins": margins,
        "bandwidth": bandwidth, "steps": steps, "shaped": shaped, "learning": learning,
        "today": today,
    }  # fmt: skip
    for part in sys.argv[1:] or parts:
        parts[part]()
