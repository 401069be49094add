"""What an identified stage is written as: numbers, a plant's parameters, a nominal model.

Numbers carry the low and high end of their 95 % interval; units stand in the names.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pea_core.params import ParameterError
from pea_core.units import NM_PER_M
from pea_identify.hysteresis import HysteresisFit, curve
from pea_identify.identified_stage import IdentifiedStage
from pea_identify.modes import Modes
from pea_identify.stage import WEAK


def interval(value: float, half: float, scale: float = 1.0) -> dict[str, float]:
    """A value with its 95 % interval."""
    value, half = float(value) * scale, abs(float(half) * scale)
    return {"value": value, "low_95": value - half, "high_95": value + half}


def of_modes(modes: Modes, gain: float = 1.0) -> list[dict[str, Any]]:
    """Modes with intervals; gains times `gain`."""
    share = modes.K[:, 0, 0] / modes.gain[0, 0]
    return [
        {
            "frequency_hz": interval(modes.omega_n[i], modes.omega_n_95[i], 0.5 / math.pi),
            "damping": interval(modes.zeta[i], modes.zeta_95[i]),
            "gain_um_per_V": interval(modes.K[i, 0, 0], modes.K_95[i, 0, 0], 1e6 * gain),
            "share": float(share[i]),
        }
        for i in range(len(modes.omega_n))
    ]


def numbers(stage: IdentifiedStage) -> dict[str, Any]:
    """All of a stage as plain numbers, for JSON; a part that is not determined is left out."""
    out: dict[str, Any] = {
        "sample_period_s": stage.T_s,
        "records": [record_of(stage, i) for i in range(len(stage.records))],
    }
    if stage.modes is not None:
        out |= numbers_of_V(stage, stage.modes)
    if stage.hysteresis is not None:
        out["hysteresis"] = numbers_of_H(stage.hysteresis, stage.tried)
    if (F_c := stage.creep) is not None:
        out["creep"] = {
            "tau_s": F_c.tau.tolist(),
            "tau_half_width_95": F_c.tau_95.tolist(),
            "weights": F_c.weights.tolist(),
            "weights_half_width_95": F_c.weights_95.tolist(),
            "total": interval(F_c.total, F_c.total_95),
            "determined_up_to_s": F_c.duration,
            "fitted_nm": F_c.fitted * NM_PER_M,
            "held_out_nm": F_c.held_out * NM_PER_M,
        }
    if stage.noise is not None:
        out["noise"] = {
            "rms_nm": interval(stage.noise.rms, stage.noise.rms_95, NM_PER_M),
            "quantisation_nm": stage.noise.quantisation * NM_PER_M,
            "samples": stage.noise.samples,
        }
    out["not_determined"] = list(stage.sentences)
    return out


def numbers_of_V(stage: IdentifiedStage, modes: Modes) -> dict[str, Any]:
    """Gain, modes, delay and lag, with the response they rest on and each amplitude alone."""
    slope = stage.small / float(modes.gain[0, 0])
    out: dict[str, Any] = {
        "gain_um_per_V": interval(stage.small, stage.small_95, 1e6),
        "modes": of_modes(modes, slope),
        "delay_us": interval(modes.delay, modes.delay_95, 1e6),
    }
    if modes.lag:
        out["amplifier_lag_us"] = interval(modes.lag, modes.lag_95, 1e6)
        out["amplifier_bandwidth_hz"] = interval(
            0.5 / (math.pi * modes.lag), 0.5 * modes.lag_95 / (math.pi * modes.lag**2)
        )
    out["response"] = {
        "held_out_error_percent": none_if_nan(100.0 * modes.error),
        "misfit": modes.misfit,
        "orders_tried": [{"modes": n, "score": score} for n, score in modes.tried],
        "through_hysteresis": stage.through_H,
    }
    out["amplitudes"] = [
        {
            "rms_V": rms,
            "gain_um_per_V": interval(m.gain[0, 0], m.gain_95[0, 0], 1e6),
            "delay_us": interval(m.delay, m.delay_95, 1e6),
            "modes": of_modes(m),
        }
        for rms, m in stage.amplitudes
    ]
    return out


def numbers_of_H(fit: HysteresisFit, tried: Sequence[HysteresisFit]) -> dict[str, Any]:
    """The hysteresis that was chosen, and how each model compared."""

    def quality(one: HysteresisFit) -> dict[str, Any]:
        return {
            "free_parameters": one.parameters,
            "fitted_percent": 100.0 * one.fitted / one.stroke,
            "held_out_percent": none_if_nan(100.0 * one.held_out / one.stroke),
        }

    return {
        "type": fit.type,
        "gain_um_per_V": interval(fit.K, fit.intervals["K"], 1e6),
        "offset_um": interval(fit.offset, fit.intervals["offset"], 1e6),
        "parameters": fit.values,
        "half_width_95": fit.intervals,
        **quality(fit),
        "stroke_um": fit.stroke * 1e6,
        "knots_um": [1e6 * k for k in fit.knots.tolist()],
        "slopes": fit.slopes.tolist(),
        "compared": [{"type": other.type, **quality(other)} for other in tried],
    }


def none_if_nan(value: float) -> float | None:
    """A number that JSON has."""
    return None if math.isnan(value) else float(value)


def record_of(stage: IdentifiedStage, i: int) -> dict[str, Any]:
    """A record, and how well the model repeats it where it can be driven."""
    r = stage.records[i]
    about = {"name": r.name, "kind": r.kind, "samples": len(r.u), "sample_period_s": r.T_s}
    if r.kind != "rest" and not math.isnan(stage.gain):
        about |= misfit(r.y[:, 0], stage.simulate(r.u[:, 0], r.T_s))
    return about


def misfit(y: np.ndarray, model: np.ndarray) -> dict[str, float]:
    """How far a model (N,) is from a displacement (N,), both in m, but for a constant."""
    error = model - y
    error = error - error.mean()
    rms = float(np.sqrt(np.mean(error**2)))
    return {
        "rms_error_nm": rms * NM_PER_M,
        "max_error_nm": float(np.abs(error).max()) * NM_PER_M,
        "nrmse_percent": 100.0 * rms / max(float(y.std()), 1e-300),
        "percent_of_stroke": 100.0 * rms / max(float(np.ptp(y)), 1e-300),
    }


def plant(stage: IdentifiedStage) -> dict[str, Any]:
    """Parameters of the plant, as its parameter file names them.

    Raises
    ------
    ParameterError
        No gain was identified, or it is not positive.
    """
    if not stage.gain > 0.0:
        raise ParameterError(
            "no gain was identified: give a record with fast motion, or a slow one"
        )
    K, hysteresis = of_hysteresis(stage.hysteresis, stage.gain)
    values: dict[str, Any] = {"T_s": stage.T_s, "K": K * 1e6, "hysteresis": hysteresis}
    modes = stage.modes
    if modes is not None:
        share = modes.K[:, 0, 0] / modes.gain[0, 0]
        strongest = int(np.abs(share).argmax())
        values["omega_n"] = float(modes.omega_n[strongest])
        values["zeta"] = float(modes.zeta[strongest])
        values["vibration"] = {
            "type": "modal",
            "omega_n": modes.omega_n.tolist(),
            "zeta": modes.zeta.tolist(),
            "K": (share * K * 1e6).tolist(),
            "delay": float(modes.delay),
        }
        if modes.lag:
            values["amplifier"] = {"bandwidth_hz": 0.5 / (math.pi * modes.lag)}
    if stage.creep is not None:
        values["creep"] = {
            "type": "linear",
            "enabled": True,
            "tau": stage.creep.tau.tolist(),
            "weights": stage.creep.weights.tolist(),
        }
    if stage.noise is not None:
        values["sensor"] = {
            "noise_nm": stage.noise.rms * NM_PER_M,
            "quantisation_nm": stage.noise.quantisation * NM_PER_M,
        }
    return values


def of_hysteresis(fit: HysteresisFit | None, gain: float) -> tuple[float, dict[str, Any]]:
    """Gain K (m/V) of V, and H as the plant's parameter file has it."""
    if fit is None or fit.type == "none":
        return gain, {"type": "none"}
    lists = {k: list(v) if isinstance(v, tuple) else v for k, v in fit.values.items()}
    if not len(fit.slopes):
        return fit.K, {"type": fit.type, **lists}
    # the curve turns about rest at 0 V: v = (y - y at rest) / K, with v = u at the largest voltage
    rest = float(curve(np.array([fit.offset]), fit.knots, fit.slopes)[0])
    r, w = np.array(fit.values["thresholds"]), np.array(fit.values["weights"]) * fit.K
    u_max = float(fit.values["u_max"])
    there = float(w @ np.maximum(u_max - r, 0.0)) + fit.offset
    K = (float(curve(np.array([there]), fit.knots, fit.slopes)[0]) - rest) / u_max
    return K, {
        "type": "modified_prandtl_ishlinskii",
        "thresholds": r.tolist(),
        "weights": (w / K).tolist(),
        "knots": ((fit.knots[1:-1] - rest) / K).tolist(),
        "slopes": fit.slopes.tolist(),
    }


def nominal(stage: IdentifiedStage) -> dict[str, Any]:
    """The linear model for an observer and a law: modes in rad/s, 1 and um/V, and the delay (s).

    Modes below 2 % of the gain are left to the margin.

    Raises
    ------
    ParameterError
        V was not identified.
    """
    modes = stage.modes
    if modes is None:
        raise ParameterError("V was not identified: give a record with fast motion")
    share = modes.K[:, 0, 0] / modes.gain[0, 0]
    kept = np.abs(share) >= WEAK
    gain = stage.gain * 1e6
    return {
        "omega_n": modes.omega_n[kept].tolist(),
        "zeta": modes.zeta[kept].tolist(),
        "K": (share[kept] / share[kept].sum() * gain).tolist(),
        "delay": float(modes.delay + modes.lag),
    }


def law(stage: IdentifiedStage) -> dict[str, Any]:
    """Preset of a law on modes: its model, and H where the law can invert it."""
    values: dict[str, Any] = {"type": "state_feedback", "model": nominal(stage)}
    _, H = of_hysteresis(stage.hysteresis, stage.gain)
    if H["type"] == "bouc_wen":
        values["inverse"] = {name: H[name] for name in ("alpha", "beta", "gamma")}
    elif H["type"].endswith("prandtl_ishlinskii") and H["thresholds"][0] == 0.0:
        names = ("thresholds", "weights", "knots", "slopes")
        values["inverse"] = {name: H[name] for name in names if name in H}
    return values


def write(stage: IdentifiedStage, there: Path) -> list[Path]:
    """Write stage.json, plant.yaml, nominal.yaml, response.csv below a directory; return them."""
    there.mkdir(parents=True, exist_ok=True)
    made = [there / "stage.json"]
    made[0].write_text(json.dumps(numbers(stage), indent=1) + "\n")
    if stage.gain > 0.0:
        made.append(there / "plant.yaml")
        text = yaml.safe_dump({"/**/plant": {"ros__parameters": plant(stage)}}, sort_keys=False)
        made[-1].write_text("# Identified; units as docs/parameters.md has them.\n" + text)
    if stage.modes is not None:
        made.append(there / "nominal.yaml")
        sections = {"/**/controller": {"ros__parameters": law(stage)}}
        made[-1].write_text(
            "# Model for a law on modes: rad/s, 1, um/V; delay in s; H to be inverted.\n"
            + yaml.safe_dump(sections, sort_keys=False)
        )
    if stage.response is not None:
        made.append(there / "response.csv")
        r = stage.response
        rows = np.column_stack(
            [r.f, r.G[:, 0, 0].real, r.G[:, 0, 0].imag, r.noise[:, 0, 0], r.total[:, 0, 0]]
        )
        head = "f [Hz],real [m/V],imag [m/V],noise variance [m2/V2],total variance [m2/V2]"
        np.savetxt(made[-1], rows, delimiter=",", header=head, comments="")
    return made
