"""What holds for every observer."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pea_core.block import Block
from pea_core.params import ParameterError, build, specs
from pea_core.signals import Estimate, Measurement
from pea_engine.kernel import open_sources
from pea_observer.model import CHOICE, MODELS

T_S = 50e-6
KNOW_EPS = [name for name, model in MODELS.items() if getattr(model, "KNOWS_EPS", True)]
KNOW_NO_EPS = sorted(set(MODELS) - set(KNOW_EPS))


def make(name: str, T_s: float = T_S, **values: object) -> Block:
    return Block(MODELS[name], build(CHOICE, {"type": name, **values}), T_s)


@pytest.mark.parametrize("name", KNOW_EPS)
@pytest.mark.parametrize("eps", [-12.0, 5.0])
def test_a_constant_unknown_input_is_found_without_bias(bench, drive, name, eps):
    u = drive(600)
    x = bench.plant(u, eps)
    last = bench.watch(make(name), x[:, 0], u)[-1]
    np.testing.assert_allclose(last, [*x[-1], eps], rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("name", KNOW_NO_EPS)
def test_an_observer_that_knows_no_unknown_input_gives_zero(bench, drive, name):
    u = drive(100)
    x = bench.plant(u, 5.0)
    assert not bench.watch(make(name), x[:, 0], u, x[:, 1])[:, 2].any()


@pytest.mark.parametrize(
    "name", [n for n in MODELS if n not in ("passthrough", "alpha_beta", "measured")]
)
def test_the_model_is_exact_from_rest_without_an_unknown_input(bench, drive, name):
    u = drive(300)
    x = bench.plant(u)
    error = bench.watch(make(name), x[:, 0], u)[:, :2] - x
    np.testing.assert_allclose(error / [1e-6, 1e-2], 0.0, atol=1e-9)


@pytest.mark.parametrize("name", [n for n in MODELS if n != "passthrough"])
def test_a_wrong_start_is_forgotten(bench, name):
    x = bench.plant(np.zeros(2000), x0=(5e-6, 0.0))
    rows = bench.watch(make(name), x[:, 0], np.zeros(2000))
    np.testing.assert_allclose(rows[-1], 0.0, atol=1e-10)


# observers on modes refuse a mode beyond half the sample rate
@pytest.mark.parametrize("name", [name for name in KNOW_EPS if not name.endswith("_modal")])
def test_one_millisecond_does_not_diverge(bench, name):
    rng = np.random.default_rng(2)
    u = 40.0 + 10.0 * rng.standard_normal(500)
    x = bench.plant(u, 5.0, 1e-3)
    y = x[:, 0] + 0.7e-9 * rng.standard_normal(501)
    error = bench.watch(make(name, 1e-3), y, u)[50:] - np.column_stack([x, np.full(501, 5.0)])[50:]
    assert np.abs(error[:, 0]).max() < 10e-9
    assert np.abs(error[:, 2]).max() < 0.1


def admissible(name: str) -> st.SearchStrategy[dict[str, object]]:
    """Values over the whole range of every parameter, spread by magnitude."""
    given_by = {}
    for key, spec in specs(CHOICE, {"type": name}).items():
        if key != "type" and spec.kind is float:
            magnitude = st.floats(math.log(spec.low or 1e-9), math.log(spec.high))
            given_by[key] = magnitude.map(
                lambda v, spec=spec: min(max(math.exp(v), spec.low), spec.high)
            )
    return st.fixed_dictionaries(given_by)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.filterwarnings("ignore")
@settings(max_examples=15, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_any_admissible_parameters_give_finite_estimates_or_are_refused(name, data):
    values = data.draw(admissible(name))
    T_s = math.exp(data.draw(st.floats(math.log(1e-5), math.log(1e-1))))
    try:
        block = make(name, T_s, **values)
    except ParameterError:
        return
    rng = np.random.default_rng(3)
    for k in range(40):
        y = 1e-5 * rng.uniform(-1.0, 1.0) if k < 30 else 0.0
        estimate = block.output(Measurement(y, 0.0, 100.0 * rng.uniform(-1.0, 1.0)))
        block.update()
        assert all(math.isfinite(value) for value in estimate)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("y", [0.0, -0.0, 5e-324, 1e-300, 1e-3, 1e100, -1e100])
def test_no_measurement_makes_it_emit_nan(name, y):
    block = make(name)
    for _ in range(20):
        estimate = block.output(Measurement(y, 0.0, 0.0))
        block.update()
        assert not any(math.isnan(value) for value in estimate)


@pytest.mark.parametrize("name", MODELS)
def test_the_defaults_suit_20_khz_and_slower(name):
    for T_s in (50e-6, 125e-6, 1e-3):
        make(name, T_s)


@pytest.mark.parametrize("name", MODELS)
def test_compiled_and_plain_give_the_same_bits(drive, name):
    numba = pytest.importorskip("numba")
    model = MODELS[name]
    open_sources(model.output, model.update)
    output, update = numba.njit(model.output), numba.njit(model.update)
    c = model.design(model.Params(), T_S)
    rng = np.random.default_rng(4)
    u = drive(300)
    y = 5e-6 + 1e-6 * np.cumsum(rng.standard_normal(300)) * 0.01
    y[:3] = 0.0
    plain, compiled = model.start(c), model.start(c)
    for k in range(300):
        measured = Measurement(float(y[k]), float(rng.standard_normal()), float(u[k]))
        a, b = model.output(c, plain, measured), output(c, compiled, measured)
        assert np.array(a).tobytes() == np.array(b).tobytes()
        plain = model.update(c, plain, measured, Estimate(*a))
        compiled = update(c, compiled, measured, b)
        assert np.hstack(plain).tobytes() == np.hstack(compiled).tobytes()


@pytest.mark.parametrize("name", MODELS)
def test_the_preset_of_its_name_can_be_designed(name):
    yaml = pytest.importorskip("yaml")
    preset = Path(__file__).parents[4] / "config" / "observers" / f"{name}.yaml"
    values = yaml.safe_load(preset.read_text())["/**/observer"]["ros__parameters"]
    assert values["type"] == name
    make(**{"name": name, **{key: v for key, v in values.items() if key != "type"}})
