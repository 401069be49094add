"""Compiled and plain models give the same bits."""

import struct
import types

import numba
import numpy as np
import pytest
from numba.extending import register_jitable

from pea_core.params import build
from pea_core.signals import Measurement
from pea_plant.drivers.simulated import Params
from pea_plant.model import load
from pea_plant.model.actuator import actuator
from pea_plant.model.hysteresis import CHOICE, MODELS

T_S = 50e-6
SAMPLES = 300


def compiled(function, done=None):
    """The function, unchanged, with all it calls open to the compiler."""
    done = set() if done is None else done
    outer = [cell.cell_contents for cell in function.__closure__ or ()]
    named = [function.__globals__.get(name) for name in function.__code__.co_names]
    for inner in outer + named:
        if isinstance(inner, types.FunctionType) and inner not in done:
            done.add(inner)
            compiled(inner, done)
            register_jitable(inner)
    return numba.njit(function)


def bits(value):
    """The floats in nested tuples and arrays, as bytes."""
    if isinstance(value, tuple):
        return b"".join(bits(v) for v in value)
    if isinstance(value, np.ndarray):
        return value.tobytes()
    return struct.pack("<d", value)


VOLTAGES = np.random.default_rng(6).uniform(-40.0, 130.0, SAMPLES)
VOLTAGES[100:110] = VOLTAGES[100]


@pytest.mark.parametrize("kind", MODELS)
def test_hysteresis(kind):
    model = MODELS[kind]
    c = model.design(build(CHOICE, {"type": kind}), T_S)
    start, output, update = (compiled(f) for f in (model.start, model.output, model.update))
    plain, fast = model.start(c), start(c)
    for u in VOLTAGES.tolist():
        plain, fast = model.update(c, plain, u), update(c, fast, u)
        assert bits(fast) == bits(plain)
        assert bits(output(c, fast)) == bits(model.output(c, plain))


@pytest.mark.parametrize("kind", load.MODELS)
def test_load(kind, tmp_path):
    values = {"type": kind}
    if kind == "file":
        path = tmp_path / "load.csv"
        path.write_text("0,0\n0.001,3\n0.007,-2\n")
        values["path"] = str(path)
    model = load.MODELS[kind]
    c = model.design(build(load.CHOICE, values), T_S, 0.142)
    output = compiled(model.output)
    for k in range(SAMPLES):
        assert bits(output(c, k)) == bits(model.output(c, k))


OFF = {"hysteresis.type": "bouc_wen", "sensor.noise_nm": 0.7}
ON = {
    "hysteresis.type": "preisach",
    "vibration.type": "modal",
    "creep.type": "log",
    "creep.enabled": True,
    "load.type": "sine",
    "amplifier.bandwidth_hz": 2000.0,
    "amplifier.slew_rate": 5e5,
    "amplifier.dac_bits": 12,
    "sensor.noise_nm": 0.7,
    "sensor.quantisation_nm": 0.5,
    "sensor.bandwidth_hz": 3000.0,
    "sensor.delay_samples": 3,
    "sensor.ideal": True,
    "delay_samples": 1,
}


@pytest.mark.parametrize("values", [OFF, ON], ids=["off", "on"])
def test_actuator(values):
    params = build(Params, values)
    model = actuator(params)
    c = model.design(params, T_S)
    start, output, update, truth = (
        compiled(f) for f in (model.start, model.output, model.update, model.truth)
    )
    noise = np.random.default_rng(7).standard_normal(SAMPLES).tolist()
    plain, fast = model.start(c), start(c)
    for u, n in zip(VOLTAGES.tolist(), noise, strict=True):
        measured, same = model.output(c, plain, n), output(c, fast, n)
        assert isinstance(same, Measurement)
        assert bits(same) == bits(measured)
        plain, fast = model.update(c, plain, n, measured, u), update(c, fast, n, same, u)
        assert bits(plain.x) == bits(fast.x)
        assert bits(truth(c, fast)) == bits(model.truth(c, plain))
