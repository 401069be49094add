"""The gate: whatever comes in, what goes out is within the limits, and every trip says why."""

import contextlib
import dataclasses
import math
from types import SimpleNamespace

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pea_core.params import ParameterError, build, specs
from pea_plant import gate as safety
from pea_plant.gate import ACTIVE, FAULT, INACTIVE, REASONS, Gate, Params, design, start, step
from pea_plant.model import actuator

T_s = 1e-3
LOW, HIGH, SLEW = -20.0, 110.0, 1000.0
ALL = {
    "slew_rate": SLEW,
    "beyond": 50.0,
    "slew_samples": 5,
    "stale_samples": 3,
    "displacement_min_um": -5.0,
    "displacement_max_um": 15.0,
    "following_error_um": 2.0,
    "following_samples": 3,
    "stuck_samples": 4,
    "stuck_voltage": 2.0,
    "jump_um": 1.0,
}

WILD = st.one_of(
    st.floats(-200.0, 200.0),
    st.sampled_from([math.nan, math.inf, -math.inf, 1e9, -1e9, 1e308]),
    st.floats(),
)
SAMPLES = st.lists(st.tuples(WILD, st.booleans(), WILD, WILD, st.floats(0.0, 3.0)), max_size=60)


def plant(**values):
    safe = build(Params, {**ALL, **values})
    return SimpleNamespace(safety=safe, voltage_min=LOW, voltage_max=HIGH)


def active(**values):
    gate = Gate(plant(**values), T_s)
    gate.configure(0.0, "test")
    gate.activate("test")
    gate.transitions.clear()
    return gate


def cause(gate):
    (transition,) = gate.transitions
    return transition.cause.partition(":")[0]


def drive(gate, commands, y=lambda k: 1e-8 * (k % 3), w=0.0):
    return [gate.step(u, True, y(k), w, 1.0) for k, u in enumerate(commands)]


@given(
    samples=SAMPLES,
    found=st.floats(LOW, HIGH),
    soft=st.sampled_from([0.0, 200.0, SLEW, 1e5]),
)
@example(samples=[(66.0, True, 0.0, 0.0, 1.0)], found=0.0, soft=1e5)
@settings(max_examples=400)
def test_no_sequence_leaves_the_range_or_exceeds_the_slew(samples, found, soft):
    """Nor in the soft start, whose own rate may be the faster one."""
    c = design(build(Params, {**ALL, "soft_start_rate": soft}), LOW, HIGH, T_s)
    s = start(ACTIVE, found)._replace(soft=c.soft)
    for u, fresh, y_um, w_um, elapsed in samples:
        before = s
        s = step(c, s, u, fresh, y_um * 1e-6, w_um * 1e-6, elapsed, elapsed)
        assert LOW <= s.u <= HIGH
        assert abs(s.u - before.u) <= SLEW * T_s * min(elapsed, 1.0) * (1 + 1e-9) + 1e-12
        assert (s.state == FAULT) == (s.reason != safety.NONE)
        if before.state == FAULT:
            assert (s.state, s.reason) == (before.state, before.reason)


@given(samples=SAMPLES, found=st.floats(-1e4, 1e4))
def test_a_stage_found_outside_its_range_ramps_in(samples, found):
    c = design(build(Params, ALL), LOW, HIGH, T_s)
    s = start(ACTIVE, found)
    for u, fresh, y_um, w_um, elapsed in samples:
        before = s.u
        s = step(c, s, u, fresh, y_um * 1e-6, w_um * 1e-6, elapsed, elapsed)
        assert abs(s.u - before) <= SLEW * T_s * min(elapsed, 1.0) + 1e-11
        assert min(LOW, before) <= s.u <= max(HIGH, before)


@given(samples=SAMPLES)
def test_the_voltage_range_holds_without_any_other_limit(samples):
    c = design(Params(), LOW, HIGH, T_s)
    assert not c.on
    s = start(ACTIVE, 0.0)
    for u, fresh, y_um, w_um, elapsed in samples:
        s = step(c, s, u, fresh, y_um * 1e-6, w_um * 1e-6, elapsed, elapsed)
        assert LOW <= s.u <= HIGH


TRIPS = {
    "command_not_finite": ([0.0, math.nan], {}, {}),
    "command_range": ([0.0, 1e9], {}, {}),
    "command_slew": ([(-1) ** k * 40.0 for k in range(9)], {}, {}),
    "sensor_not_finite": ([0.0] * 3, {"y": lambda k: math.nan if k == 2 else 0.0}, {}),
    "sensor_stuck": ([0.5 * k for k in range(30)], {"y": lambda k: 1e-6}, {}),
    "sensor_jump": ([0.0] * 4, {"y": lambda k: 1.5e-6 * (k == 3)}, {}),
    "displacement_range": ([0.0] * 40, {"y": lambda k: 0.9e-6 * k}, {"following_error_um": 0.0}),
    "following_error": ([0.0] * 9, {"w": 3e-6}, {}),
}


@pytest.mark.parametrize("reason", TRIPS)
def test_a_trip_has_its_reason_and_ramps_to_the_safe_voltage(reason):
    commands, signals, values = TRIPS[reason]
    gate = active(**values)
    drive(gate, commands, **signals)
    assert gate.state == "fault"
    assert gate.reason == reason
    assert cause(gate) == reason
    out = drive(gate, [50.0] * 200, y=lambda k: math.nan)
    assert out[-1] == 0.0
    assert gate.at_rest
    assert gate.state == "fault"


def test_every_limit_lets_a_good_loop_pass():
    gate = active()
    commands = [20.0 + 20.0 * math.sin(0.01 * k) for k in range(2000)]
    out = drive(gate, commands, y=lambda k: 0.1e-6 * math.sin(0.01 * k))
    assert gate.state == "active"
    assert out[100:] == commands[100:]


def test_a_missing_command_is_held_then_trips():
    gate = active()
    drive(gate, [0.5])
    for k in range(3):
        assert gate.step(math.nan, False, 1e-8 * k, 0.0, 1.0) == 0.5
    gate.step(math.nan, False, 0.0, 0.0, 1.0)
    assert cause(gate) == "command_stale"


@pytest.mark.parametrize(
    ("elapsed", "every", "trips"),
    [
        (1.0, 1, False),
        (1.05, 1, False),
        (1.0, 2, False),  # half of the commands
        (1.9, 1, False),  # half of the rate
        (2.5, 1, True),
        (1.0, 3, True),
        (5.0, 1, True),  # each answer takes five periods
        (1.6, 2, True),
    ],
)
def test_staleness_is_a_time(elapsed, every, trips):
    gate = active(stale_samples=40)
    for k in range(400):
        gate.step(0.5, k % every == 0, 1e-8 * (k % 3), 0.0, elapsed)
    assert (gate.reason == "command_stale") == trips
    assert (gate.state == "active") != trips


def test_a_pause_longer_than_the_stale_time_is_none():
    for pause, trips in ((4.0, False), (4.5, True)):  # a period, and three that may be stale
        gate = active()
        drive(gate, [0.5])
        gate.step(0.5, True, 1e-8, 0.0, pause)
        assert (gate.reason == "clock") == trips


@pytest.mark.parametrize(
    ("um", "apart", "trips"),
    [
        (0.9, 1.0, False),
        (1.1, 1.0, True),
        (1.1, 0.1, True),  # samples that have waited come at once
        (40.0, 41.0, False),  # forty were lost
        (40.0, 39.0, True),
        (0.9, 0.0, False),
    ],
)
def test_a_jump_counts_from_the_last_measurement(um, apart, trips):
    for elapsed in (0.02, 1.0, 1.9):  # whenever the gate is asked
        gate = active(displacement_max_um=90.0)
        drive(gate, [0.5])
        gate.step(0.5, True, um * 1e-6, 0.0, elapsed, apart)
        assert (gate.reason == "sensor_jump") == trips


@pytest.mark.parametrize("elapsed", [0.0, -1.0, 1e6, math.nan])
def test_a_clock_that_stands_or_jumps_trips(elapsed):
    gate = active(stale_samples=0)
    drive(gate, [0.5])
    gate.step(0.5, True, 1e-8, 0.0, elapsed)
    assert gate.reason == "clock"


@pytest.mark.parametrize("hertz", [1.0, 10.0, 40.0])
def test_the_soft_start_ends_in_a_time_known_beforehand(hertz):
    gate = Gate(plant(soft_start_rate=200.0, slew_samples=0), T_s)
    gate.configure(0.0, "test")
    gate.activate("test")
    longest = safety.soft_start(gate.params.safety, LOW, HIGH)
    assert longest == pytest.approx(0.65)
    command = [45.0 + 40.0 * math.sin(2.0 * math.pi * hertz * k * T_s) for k in range(1, 2000)]
    ended, u = 0, 0.0
    for k, asked in enumerate(command):
        (given,) = drive(gate, [asked], y=lambda _, k=k: 1e-8 * (k % 3), w=math.nan)
        if gate.s.soft:
            assert abs(given - u) <= 0.2 + 1e-9
        ended, u = ended or (k + 1) * (gate.s.soft == 0.0), given
    assert 0 < ended * T_s <= longest + 2 * T_s
    assert gate.state == "active"


def test_before_the_first_command_it_holds_and_waits():
    gate = Gate(plant(), T_s)
    gate.configure(7.0, "test")
    gate.activate("test")
    assert {gate.step(0.0, False, 1e-8 * (k % 2), 0.0, 1.0) for k in range(100)} == {7.0}
    assert gate.state == "active"


def test_soft_start_ramps_slower_from_what_was_measured():
    gate = Gate(plant(soft_start_rate=100.0), T_s)
    gate.configure(5.0, "test")
    gate.activate("test")
    out = drive(gate, [6.0] * 12)
    assert out[0] == pytest.approx(5.1)
    assert out[-1] == 6.0
    assert drive(gate, [7.0])[0] == 7.0


def test_the_soft_start_is_not_called_a_following_error():
    gate = active(soft_start_rate=10.0)
    drive(gate, [30.0] * 50, w=5e-6)
    assert gate.state == "active"


def test_a_fault_stays_until_reset_and_enabling_is_another_step():
    gate = active()
    assert gate.trip(safety.EMERGENCY_STOP, "asked by a test")
    assert not gate.activate("test")
    assert not gate.trip(safety.DRIVER)
    assert gate.reason == "emergency_stop"
    assert gate.reset(0.0, "test")
    assert gate.state == "inactive"
    assert gate.reason == "none"
    assert gate.activate("test")
    causes = [t.cause for t in gate.transitions]
    assert causes == ["emergency_stop: asked by a test", "test", "test"]


def test_deactivating_ramps_down_and_commands_have_no_effect():
    gate = active()
    drive(gate, [1.0 * k for k in range(20)])
    gate.deactivate("test")
    out = drive(gate, [50.0] * 30)
    assert out[0] == 18.0
    assert out[-1] == 0.0
    assert gate.at_rest


def test_a_sample_that_comes_early_changes_less():
    gate = active()
    assert gate.step(40.0, True, 0.0, 0.0, 0.25) == pytest.approx(0.25)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("slew_rate", 2000.0),
        ("beyond", 0.0),
        ("stale_samples", 4),
        ("displacement_min_um", -6.0),
        ("displacement_max_um", 16.0),
        ("jump_um", 0.0),
    ],
)
def test_while_active_limits_are_tightened_only(name, value):
    gate = active()
    with pytest.raises(ParameterError, match=f"safety.{name} = .*looser"):
        gate.adopt(plant(**{name: value}))
    gate.adopt(plant(slew_rate=500.0, stale_samples=2, displacement_min_um=-4.0))
    gate.deactivate("test")
    gate.adopt(plant(**{name: value}))


NAMES = ("voltage_min", "voltage_max", *(field.name for field in dataclasses.fields(Params)))


def changes():
    """One parameter of the gate, any of them, and a value that it may have."""
    spec = specs(actuator.Params)

    def values(name):
        known = spec.get(f"safety.{name}") or spec[name]
        if known.kind is int:
            return st.integers(int(known.low), min(int(known.high), 10**4))
        near = st.floats(max(known.low, -200.0), min(known.high, 2000.0))
        return near | st.floats(known.low, known.high)

    return st.sampled_from(NAMES).flatmap(lambda name: st.tuples(st.just(name), values(name)))


@given(wanted=st.lists(changes(), min_size=1, max_size=8))
@settings(max_examples=400, deadline=None)
def test_while_active_no_parameter_lets_the_gate_do_more(wanted):
    gate = active(safe_voltage=5.0, soft_start_rate=100.0, watchdog_s=0.4)
    first = safety.limits(gate.params)
    for name, value in wanted:
        own = {"voltage_min": gate.params.voltage_min, "voltage_max": gate.params.voltage_max}
        other = dataclasses.asdict(gate.params.safety)
        (own if name in own else other)[name] = value
        with contextlib.suppress(ParameterError):
            gate.adopt(SimpleNamespace(**own, safety=build(Params, other)))
    now = safety.limits(gate.params)
    assert gate.c.safe == 5.0
    assert {name for name in now if now[name] != first[name]}.isdisjoint(
        {"safety.safe_voltage", "safety.soft_start_rate"}
    )
    for name, value in now.items():
        if name.endswith(("_min", "_min_um")):
            assert value >= first[name]
        else:
            assert value <= first[name]
            assert value or not first[name] or "_max" in name  # 0 is no limit


def test_while_active_the_safe_voltage_stays_where_it_is():
    gate = active()
    with pytest.raises(ParameterError, match=r"safety\.safe_voltage = 100: stays 0 while"):
        gate.adopt(plant(safe_voltage=100.0))
    narrow = SimpleNamespace(safety=gate.params.safety, voltage_min=100.0, voltage_max=HIGH)
    with pytest.raises(ParameterError, match=r"voltage_min = 100: .* hold the safe voltage, 0 V"):
        gate.adopt(narrow)
    gate.deactivate("test")
    gate.adopt(narrow)
    assert drive(gate, [0.0] * 300)[-1] == 100.0


@pytest.mark.parametrize(("low", "high"), [(-21.0, HIGH), (LOW, 111.0)])
def test_while_active_the_range_is_tightened_only(low, high):
    gate = active()
    wide = SimpleNamespace(safety=gate.params.safety, voltage_min=low, voltage_max=high)
    with pytest.raises(ParameterError, match="looser"):
        gate.adopt(wide)
    gate.adopt(SimpleNamespace(safety=gate.params.safety, voltage_min=-10.0, voltage_max=60.0))
    assert drive(gate, [float(k) for k in range(100)])[-1] == 60.0


def test_the_safe_voltage_is_as_near_as_the_range_allows():
    assert design(Params(), 10.0, 100.0, T_s).safe == 10.0


def test_a_rig_without_a_slew_limit_is_refused():
    with pytest.raises(ParameterError, match=r"safety.slew_rate = 0: a rig needs"):
        safety.refuse_unlimited(plant(slew_rate=0.0))
    safety.refuse_unlimited(plant())


def test_names_and_numbers_go_together():
    assert REASONS[safety.EMERGENCY_STOP] == "emergency_stop"
    assert REASONS[safety.DISPLACEMENT_RANGE] == "displacement_range"
    assert safety.STATES[INACTIVE] == "inactive"
