import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pea_core.params import ParameterError, build
from pea_plant.model.hysteresis import prandtl_ishlinskii as pi

VOLTS = st.floats(-100.0, 120.0)
PATH = st.lists(VOLTS, min_size=1, max_size=12)
DEFAULT = pi.Params()


def follow(voltages):
    """Effective voltage after each of the voltages, from rest."""
    c = pi.design(DEFAULT, 50e-6)
    s = pi.start(c)
    v = []
    for u in voltages:
        s = pi.update(c, s, u)
        v.append(pi.output(c, s))
    return np.array(v)


def first_curve(u):
    """v on the first rise from rest."""
    r, w = np.array(DEFAULT.thresholds), np.array(DEFAULT.weights)

    def unscaled(u):
        return float(w @ np.clip(u - r, 0.0, None))

    return 84.51 * unscaled(u) / unscaled(89.09)


def test_default_gives_12_um_at_full_voltage():
    assert follow([89.09])[-1] == pytest.approx(84.51, abs=1e-12)


@given(u=st.floats(0.0, 120.0))
def test_first_rise_is_the_initial_loading_curve(u):
    assert follow([u])[-1] == pytest.approx(first_curve(u), abs=1e-11)


@given(u=st.floats(0.0, 1.0), peak=st.floats(1.0, 120.0))
def test_fall_is_twice_the_loading_curve_at_half_the_change(u, peak):
    low = peak * (2.0 * u - 1.0)
    expected = first_curve(peak) - 2.0 * first_curve((peak - low) / 2.0)
    assert follow([peak, low])[-1] == pytest.approx(expected, abs=1e-10)


@settings(max_examples=50)
@given(start=VOLTS, end=VOLTS, cuts=st.lists(st.floats(0.0, 1.0), max_size=20))
def test_does_not_depend_on_how_a_change_is_divided(start, end, cuts):
    parts = [start + (end - start) * x for x in sorted(cuts)]
    whole = follow([start, end])[-1]
    assert follow([start, *parts, end])[-1] == pytest.approx(whole, abs=1e-11)


@settings(max_examples=50)
@given(path=PATH, inside=st.lists(st.floats(0.0, 1.0), max_size=6))
def test_closed_inner_loops_are_wiped_out(path, inside):
    low, high = min(path), max(path)
    wandering = [low + (high - low) * x for x in inside]
    outer = [low, high]
    expected = follow([*path, *outer, low])[-1]
    assert follow([*path, *outer, *wandering, high, low])[-1] == pytest.approx(expected, abs=1e-10)


@settings(max_examples=50)
@given(history=PATH, other=PATH, a=VOLTS, b=VOLTS)
def test_loops_between_the_same_voltages_are_congruent(history, other, a, b):
    heights = [np.diff(follow([*past, a, b, a])[-2:])[0] for past in (history, other)]
    assert heights[0] == pytest.approx(heights[1], abs=1e-10)


@pytest.mark.parametrize(
    ("values", "rule"),
    [
        ({"thresholds": [0.0, 1.0]}, "give one weight for each threshold"),
        ({"thresholds": [0.0, 2.0, 2.0], "weights": [1.0, 1.0, 1.0]}, "must rise"),
        ({"thresholds": [50.0], "weights": [1.0], "u_max": 40.0}, "no weighted play operator"),
        ({"thresholds": [], "weights": []}, "give one weight for each threshold"),
    ],
)
def test_operators_that_cannot_be_scaled_are_refused(values, rule):
    with pytest.raises(ParameterError, match=rule):
        build(pi.Params, values)
