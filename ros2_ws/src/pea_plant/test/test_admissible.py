"""Whatever the parameters allow, the plant gives finite numbers, or refuses to be built."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pea_core.params import ParameterError, build, specs
from pea_plant.drivers.simulated import Params, Simulated

TYPES = {
    "hysteresis.type": ["none", "bouc_wen", "prandtl_ishlinskii", "preisach"],
    "vibration.type": ["second_order", "modal"],
    "creep.type": ["linear", "log"],
    "load.type": ["none", "step", "sine"],
}
LONG = {"sensor.delay_samples": 20}


def number(spec):
    """A number within the range: often its ends, or spread over its decades."""
    if spec.kind is int:
        return st.integers(int(spec.low), int(spec.high))
    ways = [st.floats(spec.low, spec.high), st.just(spec.low), st.just(spec.high)]
    if spec.low > 0.0:
        decades = st.floats(math.log(spec.low), math.log(spec.high)).map(math.exp)
        ways.append(decades.map(lambda x: min(max(x, spec.low), spec.high)))
    return st.one_of(ways)


def value(draw, name, spec):
    """A value of this parameter."""
    if spec.kind is bool:
        return draw(st.booleans())
    if spec.kind is str:
        return draw(st.sampled_from(spec.choices)) if spec.choices else ""
    if spec.kind is tuple:
        numbers = draw(st.lists(number(spec), min_size=2, max_size=2))
        return sorted(numbers) if name.endswith("thresholds") else numbers
    return min(draw(number(spec)), LONG.get(name, math.inf))


@st.composite
def settings_of_a_plant(draw):
    """Some parameters of some types."""
    values = {name: draw(st.sampled_from(kinds)) for name, kinds in TYPES.items()}
    known = specs(Params, values)
    names = sorted(name for name in known if name not in TYPES)
    for name in draw(st.lists(st.sampled_from(names), max_size=8, unique=True)):
        values[name] = value(draw, name, known[name])
    for group in ("creep", "vibration"):  # lists go together
        lists = [n for n in names if n.startswith(group) and known[n].kind is tuple]
        if any(n in values for n in lists):
            values.update({n: value(draw, n, known[n]) for n in lists})
    return values


@settings(max_examples=60, deadline=None)
@given(
    values=settings_of_a_plant(),
    u=st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=30),
)
def test_any_admissible_parameters_give_finite_numbers_or_a_refusal(values, u):
    try:
        plant = Simulated(build(Params, values), 50e-6)
    except ParameterError:
        return
    for u_k in u * 3:
        measured = plant.read()
        assert math.isfinite(measured.y)
        assert math.isfinite(measured.u_applied)
        plant.write(u_k)
        assert np.all(np.isfinite(plant.truth))
