"""Identifies stages drawn at random and says where a limit is missed.

    .ci/env python tests/identification/draws.py [--count 50] [--first 0] [--json FILE]

Limits, for each mode that makes at least 2 % of the stroke: frequency within 0.2 % (1 % where
damping is above 5 %), damping within 10 % of itself; gain for small signals within 0.3 %, delay
within 5 us, hysteresis within 0.5 % of the stroke on a motion that was not fitted.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from pea_identify import excitation
from pea_identify.records import record
from pea_identify.stage import identify

sys.path.insert(0, str(Path(__file__).parent))

from stages import T_S, Stage, draw


def records_of(stage: Stage, rng: np.random.Generator, rms: float = 0.5) -> list:
    """What a lab would record: multisines around 0 V, triangles, a step, rest."""
    N, made = 8192, []
    lines = excitation.lines_between(20.0, 8000.0, N, T_S)
    for i in range(12):
        u = np.tile(excitation.multisine(N, lines, rms, rng, 20), 4)
        made.append(record(u, stage.measured(u, rng), T_S, f"multisine {i}"))
    peaks = (80.0, 60.0, 70.0, 40.0, 80.0, 50.0, 65.0, 30.0, 75.0)
    u = excitation.triangles(0.0, peaks, 4000)
    made.append(record(u, stage.measured(u, rng), T_S, "triangles"))
    u = np.concatenate([np.zeros(2000), np.full(200_000, 40.0)])
    made.append(record(u, stage.measured(u, rng), T_S, "step"))
    made.append(record(np.zeros(20_000), stage.measured(np.zeros(20_000), rng), T_S, "rest"))
    return made


def unseen(rng: np.random.Generator) -> np.ndarray:
    """A slow motion (V) that was not fitted: three sines."""
    t = np.arange(30_000) * T_S
    u = sum(rng.uniform(5.0, 15.0) * np.sin(2.0 * np.pi * f * t) for f in (1.3, 3.1, 4.7))
    u = u - u.min()
    u = u * 75.0 / u.max()
    return np.concatenate([u[0] * (1.0 - np.cos(np.pi * np.arange(5000) / 5000)) / 2.0, u])


def judge(seed: int) -> dict:
    """Errors of one draw beside their limits."""
    stage, rng = draw(seed), np.random.default_rng(seed + 10_000)
    records = records_of(stage, rng)
    began = time.process_time()
    found = identify(records)
    spent = time.process_time() - began
    missed = []
    m = found.modes
    for f, zeta, K in zip(stage.f, stage.zeta, stage.K, strict=True):
        if K / stage.K.sum() < 0.02:
            continue
        near = np.abs(np.log(m.omega_n / (2.0 * np.pi * f))) + 0.2 * np.abs(np.log(m.zeta / zeta))
        i = int(near.argmin())
        e_f, e_z = abs(m.omega_n[i] / (2.0 * np.pi * f) - 1.0), abs(m.zeta[i] / zeta - 1.0)
        if e_f > (0.01 if zeta > 0.05 else 0.002):
            missed.append(f"frequency {f:.1f} Hz {100 * e_f:.2f} %")
        if e_z > 0.1:
            missed.append(f"damping {zeta:.4f} of {f:.1f} Hz {100 * e_z:.1f} %")
    gain = abs(found.small / stage.small - 1.0)
    if gain > 0.003:
        missed.append(f"gain {100 * gain:.3f} %")
    delay = abs(m.delay - stage.delay)
    if delay > 5e-6:
        missed.append(f"delay {delay * 1e6:.2f} us")
    u = unseen(rng)
    true = stage.true(u)[5000:]
    said = found.simulate(u, T_S)[5000:]
    apart = float(np.sqrt(np.mean((said - true) ** 2)) / np.ptp(true))
    if apart > 0.005:
        missed.append(f"hysteresis {100 * apart:.2f} % of the stroke")
    return {
        "seed": seed,
        "modes": len(stage.f),
        "found": len(m.omega_n),
        "H": stage.H,
        "chosen": found.hysteresis.type,
        "creep": bool(len(stage.tau)),
        "gain_percent": 100.0 * gain,
        "delay_us": delay * 1e6,
        "hysteresis_percent": 100.0 * apart,
        "cpu_s": round(spent, 1),
        "missed": missed,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = []
    for seed in range(arguments.first, arguments.first + arguments.count):
        row = judge(seed)
        rows.append(row)
        print(
            f"{seed:4d} {row['modes']} {row['found']} {row['H']:>18} {row['chosen']:>18} "
            f"gain {row['gain_percent']:.3f} % delay {row['delay_us']:.2f} us hysteresis "
            f"{row['hysteresis_percent']:.3f} % {row['cpu_s']} s {'; '.join(row['missed'])}",
            flush=True,
        )
    whole = sum(not row["missed"] for row in rows)
    print(f"{whole} of {len(rows)} within all limits")
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0 if whole == len(rows) else 1


if __name__ == "__main__":
    raise SystemExit(main())
