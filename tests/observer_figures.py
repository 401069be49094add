"""Measure every observer: the table of docs/observers.md.

    export PYTHONPATH=$(echo ros2_ws/src/*/ | tr ' ' ':')
    python tests/observer_figures.py [--gains] [observer ...]

A simulated actuator (Prandtl-Ishlinskii hysteresis, 0.7 nm of noise, one sample of delay, 20 kHz)
follows 5 sin + 5 um at 10 and 150 Hz. Closed loop: the recommended PIDSMC, with eps compensation.
Open loop: the feedforward of Eq 7 alone. Errors are rms over the second half of 0.6 s, against
the states of the simulated actuator. With --gains: between which gains of the actuator, as parts
of the nominal K, the closed loop without hysteresis and limits is stable. Prints Markdown.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from pea_controller import model as controllers
from pea_core.block import Block, Signal
from pea_core.loop import Loop, blocks_of, trace
from pea_core.nominal import NominalModel
from pea_core.params import build
from pea_core.signals import TRUTH, Measurement
from pea_observer import model as observers
from pea_plant.drivers.simulated import Simulated
from pea_plant.model.actuator import Params
from pea_reference import model as references

T_S = 50e-6
SAMPLES = 12_000
NOMINAL = NominalModel()


class Watched(Simulated):
    """The simulated actuator, with its true states written down."""

    def __init__(self, params: Params) -> None:
        super().__init__(params, T_S)
        self.rows: list[tuple[float, float, float]] = []

    def read(self) -> Measurement:
        x1, x2, x2_dot = self.truth
        eps = (x2_dot - NOMINAL.A21 * x1 - NOMINAL.A22 * x2) / NOMINAL.B2 - self.s.u_applied
        self.rows.append((x1, x2, eps))
        return super().read()


def block(package: Any, values: dict[str, Any]) -> Block:
    params = build(package.CHOICE, values)
    return Block(package.MODELS[package.CHOICE.type_of(params)], params, T_S)


def measure(
    observer: dict[str, Any], frequency_hz: float, closed: bool, **plant: Any
) -> dict[str, float]:
    """Rms errors of x1 (nm), x2 (um/s), eps (V), tracking (nm), and voltage step (V)."""
    law: dict[str, Any] = {"type": "pidsmc", "eps_compensation": True, "preview_samples": 0.5}
    law["delay_samples"] = 1
    if not closed:  # no feedback is a PID without gains
        law.update(type="pid", K_p=0.0, K_i=0.0, K_d=0.0, eps_compensation=False)
    watched = Watched(
        build(
            Params,
            {
                "hysteresis.type": "prandtl_ishlinskii",
                "sensor.noise_nm": 0.7,
                "sensor.ideal": observer["type"] == "passthrough",
                "delay_samples": 1,
                **plant,
            },
        )
    )
    sine = build(references.CHOICE, {"type": "sine", "frequency_hz": frequency_hz})
    reference = Signal(references.MODELS["sine"], sine, T_S)
    loop = Loop(watched, block(observers, observer), block(controllers, law), reference, T_S)
    rows = trace([loop.run(n) for n in blocks_of(SAMPLES)])[SAMPLES // 2 :]
    truth = np.array(watched.rows, TRUTH)[SAMPLES // 2 :]

    def rms(error: np.ndarray) -> float:
        return float(np.sqrt(np.mean(error**2)))

    return {
        "x1": rms(rows["x1_hat"] - truth["x1"]) * 1e9,
        "x2": rms(rows["x2_hat"] - truth["x2"]) * 1e6,
        "eps": rms(rows["eps_hat"] - truth["eps"]),
        "tracking": rms(truth["x1"] - rows["w"]) * 1e9,
        "step": rms(np.diff(rows["u"])),
    }


def stable(observer: dict[str, Any], gain: float) -> bool:
    """Whether the closed loop calms down after a start off its reference."""
    law = {"type": "pidsmc", "eps_compensation": True, "preview_samples": 0.5, "delay_samples": 1}
    free = {"voltage_min": -1e4, "voltage_max": 1e4}
    plant = {"K": gain * NOMINAL.K, "hysteresis.type": "none", "delay_samples": 1, "x10_um": 1.0}
    plant["sensor.ideal"] = observer["type"] == "passthrough"
    watched = Watched(build(Params, {**plant, **free}))
    zero = Signal(
        references.MODELS["constant"], build(references.CHOICE.kinds["constant"], {}), T_S
    )
    laws = block(controllers, {**law, **free})
    loop = Loop(watched, block(observers, observer), laws, zero, T_S)
    u = np.abs(trace([loop.run(n) for n in blocks_of(4000)])["u"])
    return bool(u[3000:].max() < 0.5 * u[1000:2000].max() or u[3000:].max() < 1e-6)


def gain_limits(observer: dict[str, Any]) -> tuple[float, float]:
    """Lowest and highest stable gain, as parts of the nominal one, to 0.01."""
    limits = []
    for far in (0.0, 4.0):
        inside, outside = 1.0, far
        while abs(outside - inside) > 0.005:
            middle = (inside + outside) / 2.0
            if stable(observer, middle):
                inside = middle
            else:
                outside = middle
        limits.append(inside)
    return limits[0], limits[1]


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure the observers.")
    parser.add_argument("observer", nargs="*", default=list(observers.MODELS))
    parser.add_argument("--gains", action="store_true", help="stable gains of the actuator")
    arguments = parser.parse_args()
    if arguments.gains:
        print("| observer | lowest gain | highest gain |\n|---|---|---|")
        for name in arguments.observer:
            low, high = gain_limits({"type": name})
            print(f"| `{name}` | {low:.2f} | {high:.2f} |", flush=True)
        return
    print("| observer | loop | f, Hz | x1, nm | x2, um/s | eps, V | x1 - w, nm | voltage step, V |")
    print("|---|---|---|---|---|---|---|---|")
    for name in arguments.observer:
        for closed in (True, False):
            for frequency in (10.0, 150.0):
                figures = measure({"type": name}, frequency, closed)
                cells = " | ".join(f"{value:.3g}" for value in figures.values())
                kind = "closed" if closed else "open"
                print(f"| `{name}` | {kind} | {frequency:g} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
