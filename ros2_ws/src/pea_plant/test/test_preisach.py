import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pea_core.params import ParameterError, build
from pea_plant.model.hysteresis import preisach

VOLTS = st.floats(-40.0, 130.0)
PATH = st.lists(VOLTS, min_size=1, max_size=12)
LOW, HIGH, SHARE = -20.0, 110.0, 0.36


def follow(voltages, params=None):
    """Effective voltage after each of the voltages, from rest."""
    c = preisach.design(params or preisach.Params(), 50e-6)
    s = preisach.start(c)
    v = []
    for u in voltages:
        s = preisach.update(c, s, u)
        v.append(preisach.output(c, s))
    return np.array(v)


def relays(voltages, n=400):
    """The same from a grid of n x n relays over the plane, each up or down."""
    x = LOW + (np.arange(n) + 0.5) * (HIGH - LOW) / n
    alpha, beta = np.meshgrid(x, x, indexing="ij")
    used = alpha > beta
    up = used & (alpha < 0.0)  # rest: risen from negative saturation to 0 V

    def raw(u, up):
        share_up = np.sum(up) / np.sum(used)
        return (1.0 - SHARE) * u + SHARE * (HIGH - LOW) * share_up

    rest = raw(0.0, up)
    scale = 84.51 / (raw(89.09, used & (alpha < 89.09)) - rest)
    v = []
    for u in voltages:
        up = (up | (used & (alpha <= u))) & ~(used & (beta >= u))
        v.append(scale * (raw(u, up) - rest))
    return np.array(v)


def test_rests_at_zero():
    c = preisach.design(preisach.Params(), 50e-6)
    assert preisach.output(c, preisach.start(c)) == 0.0
    assert follow([0.0])[-1] == 0.0


def test_default_gives_12_um_at_full_voltage():
    assert follow([89.09])[-1] == pytest.approx(84.51, abs=1e-12)


def test_limit_of_many_relays():
    path = np.array([60.0, 20.0, 45.0, -10.0, 89.0, 30.0, 70.0, 40.0, 65.0, 0.0, 105.0, -20.0])
    dense = np.concatenate(
        [np.linspace(a, b, 40) for a, b in zip([0.0, *path], path, strict=False)]
    )
    np.testing.assert_allclose(follow(dense), relays(dense), atol=0.3)


def test_rise_from_rest_is_the_parabola_of_the_uniform_density():
    u = np.linspace(1.0, 110.0, 50)

    def raw(u):
        return (1 - SHARE) * u + SHARE * ((u - LOW) ** 2 - LOW**2) / (HIGH - LOW)

    np.testing.assert_allclose(follow(u), 84.51 * raw(u) / raw(89.09), atol=1e-11)


def test_slope_just_after_a_turn_is_the_reversible_part():
    v = follow([80.0, 79.999])
    slope = (v[0] - v[1]) / 0.001
    scale = 84.51 / (0.64 * 89.09 + 0.36 * (109.09**2 - 400.0) / 130.0)
    assert slope == pytest.approx(0.64 * scale, rel=1e-4)


@settings(max_examples=50)
@given(start=VOLTS, end=VOLTS, cuts=st.lists(st.floats(0.0, 1.0), max_size=20))
def test_does_not_depend_on_how_a_change_is_divided(start, end, cuts):
    parts = [start + (end - start) * x for x in sorted(cuts)]
    whole = follow([start, end])[-1]
    assert follow([start, *parts, end])[-1] == pytest.approx(whole, abs=1e-10)


@settings(max_examples=40)
@given(path=PATH, inside=st.lists(st.floats(0.0, 1.0), max_size=8))
def test_closed_inner_loops_are_wiped_out(path, inside):
    low, high = min(path), max(path)
    wandering = [low + (high - low) * x for x in inside]
    expected = follow([*path, low, high, low])[-1]
    got = follow([*path, low, high, *wandering, high, low])[-1]
    assert got == pytest.approx(expected, abs=1e-10)


@settings(max_examples=40)
@given(history=PATH, other=PATH, a=VOLTS, b=VOLTS)
def test_loops_between_the_same_voltages_are_congruent(history, other, a, b):
    heights = [np.diff(follow([*past, a, b, a])[-2:])[0] for past in (history, other)]
    assert heights[0] == pytest.approx(heights[1], abs=1e-9)


@settings(max_examples=40)
@given(path=PATH)
def test_is_continuous(path):
    v = follow(path)
    nudged = follow([*path[:-1], path[-1] + 1e-9])
    assert abs(nudged[-1] - v[-1]) < 3e-9


@given(path=PATH)
def test_saturation_forgets_everything(path):
    assert follow([*path, 130.0, 50.0])[-1] == follow([130.0, 50.0])[-1]
    assert follow([*path, -40.0, 50.0])[-1] == follow([-40.0, 50.0])[-1]


@pytest.mark.parametrize("saturation", [-20.0, 110.0])
def test_saturation_empties_the_memory(saturation):
    c = preisach.design(preisach.Params(), 50e-6)
    s = preisach.start(c)
    for u in (80.0, 20.0, 60.0, 30.0, saturation):
        s = preisach.update(c, s, u)
    assert s.n == 1


def test_beyond_saturation_only_the_reversible_part_moves():
    v = follow([110.0, 120.0, 130.0])
    assert v[2] - v[1] == pytest.approx(v[1] - v[0], rel=1e-12)
    scale = 84.51 / (0.64 * 89.09 + 0.36 * (109.09**2 - 400.0) / 130.0)
    assert v[1] - v[0] == pytest.approx(6.4 * scale, rel=1e-12)


def spiral(turns):
    """Ever smaller swings, which a memory must all keep."""
    radius = 50.0 * (1.0 - np.arange(turns) / (turns + 1.0))
    return 45.0 + radius * (-1.0) ** np.arange(turns)


def test_memory_keeps_what_fits(monkeypatch):
    path = [*spiral(300), *spiral(300)[::-1], 100.0]
    monkeypatch.setattr(preisach, "CAPACITY", 2000)
    expected = follow(path)
    monkeypatch.undo()
    assert follow(path).tolist() == expected.tolist()


@pytest.mark.parametrize("capacity", [16, 64, 512])
def test_a_full_memory_stays_close_and_recovers(monkeypatch, capacity):
    inward = spiral(800)
    path = [*inward, *np.linspace(inward[-1], 94.0, 3000), 96.0, 10.0]
    monkeypatch.setattr(preisach, "CAPACITY", 8000)
    exact = follow(path)
    monkeypatch.setattr(preisach, "CAPACITY", capacity)
    v = follow(path)
    assert v[-2:].tolist() == exact[-2:].tolist()
    # nothing moves where the memory overflows, and each later jump is bounded
    np.testing.assert_allclose(v[:800], exact[:800], atol=1e-9)
    jump = 10.0 * SHARE * (HIGH - LOW) / capacity**2
    slope = 2.0 * (94.0 - 45.0) / 3000
    assert np.max(np.abs(np.diff(v[800:-2]))) < slope + jump


@pytest.mark.parametrize(
    ("values", "rule"),
    [
        ({"range_min": 5.0}, "range_min = 5.0: must be -10000 to 0 V"),
        ({"u_max": 1e-3, "v_max": 1e4}, "gives H a slope above 1000"),
        ({"share": 1.5}, "share = 1.5: must be 0 to 1"),
    ],
)
def test_parameters_without_sense_are_refused(values, rule):
    with pytest.raises(ParameterError, match=rule):
        build(preisach.Params, values)
