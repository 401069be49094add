"""What every control law must do: compile to the same bits, stay finite, take its presets."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from pea_controller.model import CHOICE, MODELS, smc
from pea_core.block import Block
from pea_core.params import ParameterError, build, flatten, specs
from pea_core.signals import Estimate, Reference

T_S = 50e-6
PRESETS = Path(__file__).parents[4] / "config" / "controllers"


def floats(state):
    """Everything in a state, so that two of them can be compared."""
    if isinstance(state, np.ndarray):
        return state.tolist()
    return [floats(part) for part in state] if isinstance(state, tuple) else state


def numbers(state):
    """The same in one list."""
    if isinstance(state, tuple | list):
        return [number for part in state for number in numbers(floats(part))]
    return [state]


def signals(samples):
    rng = np.random.default_rng(7)
    for w, w_dot, w_ddot, x1, x2, eps in rng.normal(size=(samples, 6)).tolist():
        W = Reference(w * 5e-6, w_dot * 1e-3, w_ddot)
        yield W, Estimate(x1 * 5e-6, x2 * 1e-3, eps * 5)


@pytest.mark.parametrize("name", MODELS)
def test_compiled_law_gives_the_same_bits(name, compiled):
    model = MODELS[name]
    c = model.design(model.Params(eps_compensation=True), T_S)
    output, update = compiled(model.output), compiled(model.update)
    s, s_compiled = model.start(c), compiled(model.start)(c)
    for W, x in signals(300):
        u = model.output(c, s, W, W, x)
        assert output(c, s_compiled, W, W, x) == u
        s = model.update(c, s, W, W, x, u)
        s_compiled = update(c, s_compiled, W, W, x, u)
        assert floats(s_compiled) == floats(s)


@pytest.mark.parametrize("name", [n for n in MODELS if hasattr(MODELS[n], "absorb")])
@pytest.mark.parametrize("delay", [0, 1])
def test_what_a_law_absorbs_is_in_its_next_command(name, delay):
    model = MODELS[name]
    c = model.design(model.Params(delay_samples=delay), T_S)
    s = model.start(c)
    for W, x in signals(20):
        u = model.output(c, s, W, W, x)
        moved = model.output(c, model.absorb(c, s, 3.5), W, W, x)
        assert moved - u == pytest.approx(3.5, abs=1e-9)
        s = model.update(c, s, W, W, x, u)


@pytest.mark.parametrize("values", [{"type": "pid", "K_i": 0.0}, {"type": "pidsmc", "I": 0.0}])
def test_an_integral_that_nothing_leads_back_absorbs_nothing(values):
    model = MODELS[values["type"]]
    c = model.design(build(CHOICE, values), T_S)
    s = model.start(c)
    assert model.absorb(c, s, 3.5) is s


def test_the_steady_part_of_smc_is_its_command_on_the_sliding_surface():
    c = smc.design(smc.Params(), T_S)
    W = Reference(3e-6, 1e-3, 2.0)
    x = Estimate(W.w, W.w_dot, 4.0)  # q = 0
    assert smc.steady(c, smc.start(c), W, W, x) == smc.output(c, smc.start(c), W, W, x)


def any_law(name, data):
    """A law with any admissible parameters; None where it is refused, which is as good."""
    values = {
        n: data.draw(st.floats(s.low, s.high), n)
        for n, s in specs(MODELS[name].Params).items()
        if s.kind is float and "voltage" not in n
    }
    try:
        return Block(MODELS[name], build(MODELS[name].Params, values), T_S)
    except ParameterError:
        return None


@pytest.mark.parametrize("name", MODELS)
@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_any_admissible_law_answers_any_signals_with_finite_numbers(name, data):
    if (law := any_law(name, data)) is None:
        return
    w, w_dot, w_ddot, x1, x2, eps = data.draw(st.tuples(*[st.floats(-1.0, 1.0)] * 6))
    W, x = Reference(w * 1e-4, w_dot, w_ddot * 1e4), Estimate(x1 * 1e-4, x2, eps * 100.0)
    for _ in range(3):
        u = law.output(W, W, x)
        law.update()
        assert np.isfinite(u)
        assert np.isfinite(numbers(law.s)).all()


@pytest.mark.parametrize("name", MODELS)
@settings(max_examples=20, deadline=None)
@given(data=st.data())
def test_any_admissible_law_stays_finite_in_the_loop(name, data, simulate, sine):
    if (law := any_law(name, data)) is None:
        return
    run = simulate(law, sine(150.0), 200, limits=(-20.0, 110.0), eps=6.0)
    assert all(np.isfinite(column).all() for column in run)


@pytest.mark.parametrize("path", sorted(PRESETS.glob("*.yaml")), ids=lambda p: p.stem)
def test_preset_names_parameters_of_its_law(path):
    values = yaml.safe_load(path.read_text())["/**/controller"]["ros__parameters"]
    flat = flatten(CHOICE, build(CHOICE, values))
    told = {n: tuple(v) if isinstance(v, list) else v for n, v in values.items()}
    assert {name: flat[name] for name in values} == told


@pytest.mark.parametrize("path", sorted(PRESETS.glob("*.yaml")), ids=lambda p: p.stem)
def test_preset_leaves_limits_and_model_to_others(path):
    values = yaml.safe_load(path.read_text())["/**/controller"]["ros__parameters"]
    others = {"voltage_min", "voltage_max", "delay_samples", "K", "zeta", "omega_n"}
    assert not others & set(values)


@pytest.mark.parametrize("path", sorted(PRESETS.glob("*.yaml")), ids=lambda p: p.stem)
def test_preset_follows_a_sine_on_the_nominal_plant(path, simulate, sine):
    values = yaml.safe_load(path.read_text())["/**/controller"]["ros__parameters"]
    params = build(CHOICE, values)
    if hasattr(params, "model"):
        pytest.skip("it is for a stage of its own: test_modal_laws.py")
    w = sine(10.0, phase=-np.pi / 2)
    model = MODELS[CHOICE.type_of(params)]
    law = Block(model, params, T_S)
    run = simulate(law, w, 4000, limits=(-20.0, 110.0))
    error = run.x1 - [w(k * T_S).w for k in range(4000)]
    bound = 200e-9 if hasattr(model, "switching") else 50e-9  # that stays within its band
    assert np.abs(error[2000:]).max() < bound
