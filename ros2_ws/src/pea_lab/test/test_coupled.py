"""Poles and margins of a coupled stage, beside those of its axes, random gains and simulations."""

import itertools

import numpy as np
import pytest

from pea_core.params import ParameterError
from pea_experiment import experiments
from pea_lab import check, linear
from pea_lab.check import radius
from pea_lab.coupled import CoupledLoop, check_axes, coupled, refuse_unstable, together

SETS = ("axes=[x,y]", "controller.preset=recommended", "observer.preset=extended_state")


def two(*sets):
    """The loop of Fig 9 on two axes."""
    return experiments.load_axes("fig9_hysteresis_10hz", [*SETS, *sets], 0.05)


def alone(axis, *sets):
    """One axis of it."""
    return experiments.load(f"fig9_hysteresis_10hz@{axis}", [*SETS, *sets], 0.05)


MARGINS = ("gain_margin_upper", "delay_margin_samples", "phase_margin_deg", "modulus_margin")


def test_without_coupling_it_is_the_loops_of_the_axes():
    sets = ("plant.y.K=0.12", "plant.sensor.delay_samples=1", "plant.y.delay_samples=2")
    found = check_axes(two(*sets))
    own = {axis: check.check(alone(axis, *sets)) for axis in "xy"}
    assert found["stable"]
    assert found["largest_pole"] == pytest.approx(
        max(one["largest_pole"] for one in own.values()), rel=1e-9
    )
    for axis, name in itertools.product("xy", MARGINS):
        assert found["axes"][axis][name] == pytest.approx(own[axis][name], rel=1e-3), name


def test_axes_turned_against_sensors_and_actuators_have_the_same_margins():
    s = np.sqrt(0.5)
    turned = (
        f"plant.stage.axes_to_actuators=[{s}, {-s}, {s}, {s}]",
        f"plant.stage.sensors_to_axes=[{s}, {s}, {-s}, {s}]",
    )
    plain, found = check_axes(two()), check_axes(two(*turned))
    assert found["largest_pole"] == pytest.approx(plain["largest_pole"], rel=1e-9)
    for name in ("determinant_modulus", "disk_margin"):
        assert found[name] == pytest.approx(plain[name], rel=1e-6)
    for name in MARGINS:
        assert found["axes"]["y"][name] == pytest.approx(plain["axes"]["y"][name], rel=1e-5)


def crossed(share):
    """A stage whose axes disturb each other, one of them at rest, or nearly."""
    return two(
        f"plant.stage.cross_talk=[0, {share}, {share}, 0]",
        "plant.hysteresis.type=none",
        "reference.amplitude_um=1",
        "reference.offset_um=0",
        "reference.y.amplitude_um=0.01",
    )


def test_the_cross_talk_at_which_it_turns_unstable_is_that_of_the_simulation():
    def largest(share):
        return radius(coupled(crossed(share)).closed())

    shares = np.linspace(0.0, 2.0, 81)
    over = np.array([largest(share) > 1.0 for share in shares])
    edge = shares[np.argmax(over)]
    assert 0.2 < edge < 2.0
    sizes = {}
    for share in (edge - 0.1, edge + 0.1):
        loop = crossed(share).loop()
        rows = np.concatenate([loop.run(500) for _ in range(2)])
        sizes[share] = np.abs(rows["y"] - rows["w"])[-100:].max()
    assert sizes[edge - 0.1] < 1e-7
    assert sizes[edge + 0.1] > 1e-5


def test_within_the_disk_margin_every_gain_of_each_loop_is_stable():
    loop = coupled(two("plant.stage.cross_talk=[0, 0.2, -0.3, 0]"))
    found = together(loop)
    low, high = found["disk_gain_lower"], found["disk_gain_upper"]
    assert low < 0.7
    rng = np.random.default_rng(5)
    for gains in np.exp(rng.uniform(np.log(low), np.log(high), (60, 2))):
        assert radius(loop.A + (loop.B * gains) @ loop.C) < 1.0
    corners = [np.array(each) for each in itertools.product((low * 1.001, high * 0.999), repeat=2)]
    assert all(radius(loop.A + (loop.B * gains) @ loop.C) < 1.0 for gains in corners)


def test_disk_margin_of_one_loop_is_that_of_the_definition():
    rng = np.random.default_rng(2)
    A = 0.5 * np.linalg.qr(rng.normal(size=(4, 4)))[0]
    loop = CoupledLoop(A, rng.normal(size=(4, 1)) * 0.1, rng.normal(size=(1, 4)) * 0.1)
    w = np.linspace(1e-3, np.pi, 20_001)
    z = np.exp(1j * w)
    L = np.array([loop.C @ np.linalg.solve(p * np.eye(4) - A, loop.B) for p in z])[:, 0, 0]
    S = 1.0 / (1.0 - L)
    found = together(loop)
    assert found["disk_margin"] == pytest.approx(min(1.0 / np.abs(S - 0.5).max(), 2.0), rel=1e-4)
    assert found["determinant_modulus"] == pytest.approx(np.abs(1.0 - L).min(), rel=1e-4)


def test_an_unstable_stage_is_refused_and_a_nonlinear_one_named():
    with pytest.raises(ParameterError, match="unstable on the nominal stage"):
        refuse_unstable(crossed(2.5))
    refuse_unstable(crossed(0.1))
    found = check_axes(two("observer.y.type=levant"))
    assert not found["linear"]
    assert found["note"].startswith("y: ")


def test_delays_that_differ_behind_a_matrix_are_not_guessed():
    made = two("plant.x.sensor.delay_samples=3", "plant.stage.sensors_to_axes=[1, 1, 1, -1]")
    assert "not combined" in check_axes(made)["note"]


def test_a_tuple_in_a_state_is_filled_in():
    state = ((1.0, np.zeros(2)), 3)
    assert linear.numbers(state) == [1.0, 0.0, 0.0]
    (first, array), count = linear.filled(state, iter([2.0, 3.0, 4.0]))
    assert (first, array.tolist(), count) == (2.0, [3.0, 4.0], 3)


def test_a_response_of_many_states_is_the_same_by_a_triangular_matrix(monkeypatch):
    random = np.random.default_rng(1)
    A = random.normal(size=(90, 90))
    A *= 0.999 / radius(A)
    system = linear.System(A, random.normal(size=(90, 2)), random.normal(size=(3, 90)), 0.0)
    z = np.exp(1j * np.geomspace(1e-4, np.pi, 200))
    found = linear.at(system, z)
    monkeypatch.setattr(linear, "MANY", 1000)
    solved = linear.at(system, z)
    assert found.shape == (200, 3, 2)
    np.testing.assert_allclose(found, solved, atol=1e-9 * np.abs(solved).max())
    assert not np.array_equal(found, solved)  # it goes another way
