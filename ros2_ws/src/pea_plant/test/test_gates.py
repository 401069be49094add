"""Gates of several axes trip together, each with limits of its own."""

import math

import pytest

from pea_core.params import ParameterError, build
from pea_plant.gate import ACTIVE, FAULT, REASONS
from pea_plant.gates import Gates
from pea_plant.plant import Params

T_s = 1e-3
LIMITS = {
    "voltage_min": -20.0,
    "voltage_max": 100.0,
    "safety.slew_rate": 1e4,
    "safety.beyond": 50.0,
    "safety.stale_samples": 20,
    "safety.jump_um": 1.0,
    "safety.stuck_samples": 900,
}


def gates(**of_y):
    """Gates of x and y, active at 0 V; parameters of y, and of the stage for both."""
    stage = {name: value for name, value in of_y.items() if name.startswith("stage")}
    both = {name.replace("__", "."): value for name, value in stage.items()}
    own = {name.replace("__", "."): value for name, value in of_y.items() if name not in stage}
    params = build(Params, {**LIMITS, **both}), build(Params, {**LIMITS, **both, **own})
    made = Gates(params, T_s, ("x", "y"))
    made.configure((0.0, 0.0), "test")
    made.activate("test")
    made.transitions.clear()
    return made


def step(made, u=(5.0, 5.0), y=(0.0, 0.0)):
    return made.step(u, True, y, (0.0, 0.0), 1.0, 1.0)


def test_each_axis_keeps_its_own_limits():
    made = gates(voltage_max=3.0, safety__slew_rate=1e3)
    assert step(made) == (5.0, 1.0)
    for _ in range(5):
        found = step(made)
    assert found == (5.0, 3.0)
    assert made.state == "active"


@pytest.mark.parametrize("axis", [0, 1])
def test_a_trip_of_one_is_a_trip_of_all_at_the_same_sample(axis):
    made = gates()
    for _ in range(20):
        step(made, (50.0, 40.0))
    y = [0.0, 0.0]
    y[axis] = 5e-6
    assert step(made, (50.0, 40.0), tuple(y)) == (40.0, 30.0)
    assert [own.s.state for own in made.each] == [FAULT, FAULT]
    reasons = [REASONS[own.s.reason] for own in made.each]
    assert reasons == (
        ["sensor_jump", "other_axis"] if axis == 0 else ["other_axis", "sensor_jump"]
    )
    assert made.reason == "sensor_jump"
    (transition,) = made.transitions
    assert transition.cause.startswith(f"{'xy'[axis]}: sensor_jump: 5.0000 um")
    for _ in range(5):
        step(made, (50.0, 40.0), tuple(y))
    assert made.at_rest
    assert made.reset((0.0, 0.0), "test")
    assert made.state == "inactive"


def test_what_no_gate_sees_trips_all():
    made = gates()
    assert made.trip(REASONS.index("driver"), "no answer")
    assert not made.trip(REASONS.index("driver"), "again")
    assert [own.s.state for own in made.each] == [FAULT, FAULT]
    assert [one.cause for one in made.transitions] == ["driver: no answer"]
    assert made.cause == "driver: no answer"


def test_axes_that_leave_the_permitted_area_trip():
    made = gates(
        stage__permitted_um=(-2.0, -2.0, 2.0, -2.0, 2.0, 2.0), safety__displacement_max_um=9.0
    )
    step(made, y=(1e-6, 0.5e-6))
    assert made.s.state == ACTIVE
    step(made, y=(0.5e-6, 1e-6))
    assert made.reason == "permitted_area"
    assert [own.s.state for own in made.each] == [FAULT, FAULT]


def test_the_permitted_area_is_one_of_axes_not_of_sensors():
    turned = (0.0, 1.0, 1.0, 0.0)  # the first sensor looks at y
    made = gates(
        stage__permitted_um=(-2.0, -2.0, 2.0, -2.0, 2.0, 2.0), stage__sensors_to_axes=turned
    )
    step(made, y=(0.5e-6, 1e-6))
    assert made.s.state == ACTIVE
    step(made, y=(1e-6, 0.5e-6))
    assert made.reason == "permitted_area"


def test_limits_get_tighter_only_and_for_all_or_for_none():
    made = gates()
    looser = build(Params, {**LIMITS, "safety.slew_rate": 2e4})
    tighter = build(Params, {**LIMITS, "safety.slew_rate": 5e3})
    with pytest.raises(ParameterError, match="looser"):
        made.adopt((tighter, looser))
    assert made.params[0].safety.slew_rate == 1e4
    made.adopt((tighter, tighter))
    assert step(made, (50.0, 50.0)) == (5.0, 5.0)


def test_a_command_that_is_no_number_on_one_axis_trips():
    made = gates()
    step(made, (5.0, math.nan))
    assert made.cause.startswith("y: command_not_finite")
