"""The mirror of measured data as a stage of three actuators: `config/plants/mirror.yaml`.

    .ci/env python docs/mirror.py fit FSM.npz     # writes the plant from measured periods
    .ci/env python docs/mirror.py table           # cross-talk with and without decoupling

The data (u, y: samples x 3 x realisations x periods, fs) are those of merijnfloren/
fsm-benchmark-data, CC BY 4.0, (c) 2025 Merijn Floren, KU Leuven.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
PLANT = ROOT / "config/plants/mirror.yaml"
AXES = ("a", "b", "c")
SIGNS = np.array([-1.0, -1.0, 1.0])
"""Sensors counted so that each moves with its own actuator."""

PAIRS = 9
DELAYS = np.arange(0.0, 300e-6, 5e-6)
ABOVE = 4500.0
"""Frequency (Hz) of one mode that stands for all above what was measured."""


def fit(there: Path) -> dict[str, Any]:
    """Modes common to all paths, real gains of each, a delay, fitted to a frequency response."""
    from pea_identify import frequency_response
    from pea_identify.axes import fitted

    data = np.load(there)
    u, y, T_s = data["u"], data["y"] * SIGNS[None, :, None, None], 1.0 / float(data["fs"])
    response = frequency_response.from_periods(u, y, T_s)
    s_p = np.log(fitted(response, SimpleNamespace(u=u, y=y, T_s=T_s), PAIRS).poles) / T_s
    omega, zeta = np.abs(s_p), -s_p.real / np.abs(s_p)
    kept = [i for i in np.argsort(omega) if zeta[i] < 0.05]
    omega = np.append(omega[kept], 2.0 * math.pi * ABOVE)
    zeta = np.append(zeta[kept], 0.02)
    s = 2j * math.pi * response.f[:, None]
    modes = omega**2 / (s * s + 2.0 * zeta * omega * s + omega**2)
    G = response.G.reshape(len(s), -1)
    best: tuple[float, float, np.ndarray] = (math.inf, 0.0, np.zeros(0))
    for delay in DELAYS:
        A = modes * np.exp(-s * delay)
        K, *_ = np.linalg.lstsq(np.vstack([A.real, A.imag]), np.vstack([G.real, G.imag]), None)
        error = np.linalg.norm(A @ K - G) / np.linalg.norm(G)
        if error < best[0]:
            best = float(error), float(delay), K * 1e6
    error, delay, K = best
    K = K.T.reshape(3, 3, -1)
    return {"omega": omega, "zeta": zeta, "K": K, "delay": delay, "error": error}


def write(found: dict[str, Any]) -> None:
    """Write the plant's file."""
    K = found["K"]

    def row(values: Any, digits: int) -> str:
        return "[" + ", ".join(repr(float(f"{v:.{digits}g}")) for v in values) + "]"

    rounded = np.array([[[float(f"{v:.4g}") for v in path] for path in out] for out in K])
    lines = [
        "# A fast steering mirror on three actuators, identified by docs/mirror.py from data of",
        "# merijnfloren/fsm-benchmark-data, CC BY 4.0, (c) 2025 Merijn Floren, KU Leuven.",
        f"# {len(found['omega'])} modes with real gains and one delay leave "
        f"{100 * found['error']:.1f} % of the response",
        "# that was measured at 300 mV rms. Sensors a and b count the other way.",
        "/**/plant:",
        "  ros__parameters:",
        "    axes: [a, b, c]",
        f"    zeta: {found['zeta'][0]:.4g}",
        f"    omega_n: {found['omega'][0]:.6g}  # rad/s",
        "    vibration:",
        "      type: modal",
        f"      omega_n: {row(found['omega'], 6)}  # rad/s",
        f"      zeta: {row(found['zeta'], 4)}",
        f"      delay: {found['delay']:.4g}  # s",
        "    hysteresis.type: none",
        "    creep.enabled: false",
        "    sensor.noise_nm: 0.7",
        "    voltage_min: -10.0",
        "    voltage_max: 10.0",
    ]
    for i, axis in enumerate(AXES):
        lines += [
            f"    {axis}:",
            f"      K: {rounded[i, i].sum():.4g}  # um/V",
            f"      seed: {i + 1}",
            f"      vibration.K: {row(rounded[i, i], 4)}  # um/V",
        ]
    lines.append("    stage.modes_K: [  # um/V, by sensor, actuator, mode")
    lines += [f"      {row(path, 4)[1:-1]}," for path in rounded.reshape(9, -1)]
    lines += ["    ]", ""]
    PLANT.write_text("\n".join(lines))


def gains() -> np.ndarray:
    """Steady-state gains (um/V) from actuators to sensors, as the plant's file says."""
    from pea_experiment import experiments

    made = experiments.load_axes("mirror")
    own = [one.nodes["plant"].params for one in made.each]
    modes = len(own[0].vibration.K)
    found: np.ndarray = np.array(own[0].stage.modes_K).reshape(3, 3, modes).sum(axis=2)
    return found


def decoupling(K: np.ndarray) -> np.ndarray:
    """Matrix from axes to actuators with which each axis moves alone at rest, as far as its own."""
    found: np.ndarray = np.linalg.solve(K, np.diag(np.diag(K)))
    return found


def pea(*words: str) -> dict[str, Any]:
    """Figures that a command prints as JSON."""
    done = subprocess.run(
        [str(ROOT / "pea"), *words, "--json"], capture_output=True, text=True, check=True
    )
    found: dict[str, Any] = json.loads(done.stdout)
    return found


FREQUENCIES = (5.0, 20.0, 50.0)


def table() -> None:
    """Print what one axis does to the others, with and without decoupling."""
    A = [float(f"{v:.4g}") for v in decoupling(gains()).ravel()]
    ways = {"none": (), "static": ("--set", f"plant.stage.axes_to_actuators={A}")}
    print("| decoupling | disk margin | Hz | error of a | b to a | c to a |")
    print("|---|---|---|---|---|---|")
    for way, sets in ways.items():
        margin = pea("check", "mirror", *sets)["disk_margin"]
        for f in FREQUENCIES:
            at = ("--set", f"reference.frequency_hz={f}", "--out")
            with tempfile.TemporaryDirectory() as there:
                own = pea("run", "mirror", *sets, *at, f"{there}/run")["axes"]
            moved = 1e3 / math.sqrt(2.0)  # nm rms that a should move
            error = own["a"]["rms_error_nm"]
            others = (20.0 * math.log10(own[name]["rms_error_nm"] / moved) for name in "bc")
            told = " | ".join(f"{dB:.1f} dB" for dB in others)
            print(f"| {way} | {margin:.2f} | {f:g} | {error:.0f} nm | {told} |", flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["fit"]:
        write(fit(Path(sys.argv[2])))
        print(PLANT)
    elif sys.argv[1:] == ["table"]:
        table()
    else:
        raise SystemExit(__doc__)
