"""A stage of several actuators: what couples them, and the gate that trips all."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.path import Path as Polygon
from scipy import signal
from scipy.linalg import block_diag, expm

from pea_core.params import ParameterError, build
from pea_plant.driven import Between
from pea_plant.drivers.simulated import Simulated
from pea_plant.gate import UnsafeCommand
from pea_plant.model.stage import area, inside
from pea_plant.plant import Params
from pea_plant.rig import Rig
from pea_plant.stage import Stage

T_S = 50e-6
AXES = ("x", "y", "z")
MODES = {
    "vibration.type": "modal",
    "vibration.omega_n": (4643.0, 12566.0),
    "vibration.zeta": (0.01, 0.02),
    "vibration.K": (0.135, 0.007),
}
LINEAR = {"hysteresis.type": "none", "sensor.ideal": True}


def stage(n, *own, **shared):
    """A stage of n linear actuators; `own` are values of each axis, `shared` those of the stage."""
    coupling = {f"stage.{name}": value for name, value in shared.items()}
    own = own or ({},) * n
    each = [Simulated(build(Params, {**LINEAR, **values, **coupling}), T_S) for values in own]
    return Stage(each, AXES[:n])


def driven(plant, commands):
    """Measured displacements (n, axes), true ones, and applied voltages."""
    y, x1, u = [], [], []
    for command in commands:
        measured = plant.read()
        y.append([one.y for one in measured])
        u.append([one.u_applied for one in measured])
        x1.append([true.x1 for true in plant.truth])
        plant.write(tuple(command))
    return np.array(y), np.array(x1), np.array(u)


@pytest.fixture
def commands():
    return np.random.default_rng(3).uniform(-15.0, 15.0, (200, 2))


def test_actuators_that_nothing_couples_move_as_alone(commands):
    y, x1, _ = driven(stage(2, MODES, {"K": 0.2}), commands)
    for axis, values in enumerate((MODES, {"K": 0.2})):
        alone = Simulated(build(Params, {**LINEAR, **values}), T_S)
        for k, u in enumerate(commands[:, axis]):
            assert alone.read().y == y[k, axis]
            assert alone.truth.x1 == x1[k, axis]
            alone.write(u)


def test_static_cross_talk_adds_a_share_of_the_other_axis(commands):
    alone, _, _ = driven(stage(2), commands)
    y, x1, _ = driven(stage(2, cross_talk=(0.0, 0.1, -0.03, 0.0)), commands)
    expected = alone @ np.array([[1.0, 0.1], [-0.03, 1.0]]).T
    np.testing.assert_allclose(y, expected, rtol=1e-12, atol=1e-20)
    np.testing.assert_allclose(x1, expected, rtol=1e-12, atol=1e-20)


def test_modes_shared_by_all_sensors_are_those_of_the_whole_system(commands):
    """The exact step of the multi-variable system, each path a sum of modes, by scipy."""
    K = np.array([[[0.0, 0.0], [0.004, -0.006]], [[-0.002, 0.01], [0.0, 0.0]]])
    y, x1, _ = driven(stage(2, MODES, MODES, modes_K=tuple(K.ravel())), commands)
    own = np.array(MODES["vibration.K"])
    for i, j in itertools.product(range(2), range(2)):
        K[i, j] = own if i == j else K[i, j]
    A, B, C = [], np.zeros((8, 2)), np.zeros((2, 8))
    for j in range(2):
        for m, (w, z) in enumerate(zip(MODES["vibration.omega_n"], MODES["vibration.zeta"])):
            row = 2 * (2 * j + m)
            A.append([[0.0, 1.0], [-w * w, -2.0 * z * w]])
            B[row + 1, j] = w * w
            C[:, row] = K[:, j, m] * 1e-6
    A = block_diag(*A)
    whole = expm(np.block([[A, B], [np.zeros((2, 10))]]) * T_S)
    A_d, B_d, x = whole[:8, :8], whole[:8, 8:], np.zeros(8)
    for k, u in enumerate(commands):
        np.testing.assert_allclose(y[k], C @ x, rtol=1e-9, atol=1e-16)
        np.testing.assert_allclose(x1[k], C @ x, rtol=1e-9, atol=1e-16)
        x = A_d @ x + B_d @ u


def test_velocity_and_acceleration_of_cross_talk_are_derivatives():
    plant = stage(2, MODES, MODES, modes_K=(0.0, 0.0, 0.01, 0.02, 0.03, -0.01, 0.0, 0.0))
    h = T_S / 50.0
    fine = [Simulated(block.params, h) for block in plant.blocks]
    plant = Stage(fine, plant.axes)
    x1, x2, x2_dot = [], [], []
    for _ in range(2000):
        plant.read()
        true = plant.truth
        x1.append([one.x1 for one in true])
        x2.append([one.x2 for one in true])
        x2_dot.append([one.x2_dot for one in true])
        plant.write((10.0, -5.0))
    x1, x2, x2_dot = map(np.array, (x1, x2, x2_dot))
    slope = (x1[2:] - x1[:-2]) / (2.0 * h)
    bend = (x2[2:] - x2[:-2]) / (2.0 * h)
    np.testing.assert_allclose(x2[1:-1], slope, rtol=0, atol=2e-3 * np.abs(x2).max())
    scale = np.abs(x2_dot).max()
    np.testing.assert_allclose(x2_dot[2:-1], bend[1:], rtol=0, atol=2e-2 * scale)


def test_axes_are_combinations_of_sensors_and_of_actuators(commands):
    """Piston and tilt from two points: each axis alone, as if its actuators were one."""
    S, A = (0.5, 0.5, 1.0, -1.0), (1.0, 0.5, 1.0, -0.5)
    y, x1, u = driven(stage(2, sensors_to_axes=S, axes_to_actuators=A), commands)
    actuators = commands @ np.array(A).reshape(2, 2).T
    alone, _, applied = driven(stage(2), actuators)
    np.testing.assert_allclose(y, alone @ np.array(S).reshape(2, 2).T, rtol=1e-12, atol=1e-20)
    np.testing.assert_allclose(x1, y, rtol=1e-12, atol=1e-20)
    expected = applied @ np.linalg.inv(np.array(A).reshape(2, 2)).T
    np.testing.assert_allclose(u, expected, rtol=1e-12, atol=1e-12)
    tilt = np.zeros((50, 2))
    tilt[:, 1] = 5.0
    y, _, _ = driven(stage(2, sensors_to_axes=S, axes_to_actuators=A), tilt)
    assert np.abs(y[:, 0]).max() < 1e-20
    assert np.abs(y[:, 1]).max() > 1e-7


TAPS = np.array([[[0.9, 0.2], [-0.1, 1.1]], [[0.3, 0.0], [0.1, -0.2]], [[-0.1, 0.05], [0.0, 0.1]]])


def test_a_filter_from_axes_to_actuators_is_that_of_scipy(commands):
    """And each axis is told that it got what it asked for, a sample later."""
    u_actuators = sum(lfilter(TAPS[:, :, j], commands[:, j]) for j in range(2))
    expected, _, _ = driven(stage(2), u_actuators)
    y, x1, u = driven(stage(2, axes_to_actuators=tuple(TAPS.ravel())), commands)
    np.testing.assert_allclose(y, expected, rtol=1e-9, atol=1e-18)
    np.testing.assert_allclose(x1, expected, rtol=1e-9, atol=1e-18)
    np.testing.assert_allclose(u[1:], commands[:-1], rtol=1e-9, atol=1e-9)


def lfilter(taps, u):
    """Response (n, 2) of two actuators to the command u (n) of one axis; taps (N, 2)."""
    return np.stack([signal.lfilter(own, 1.0, u) for own in taps.T], axis=1)


def test_a_filter_of_one_tap_is_the_matrix_to_the_bit(commands):
    one = driven(stage(2, axes_to_actuators=(0.9, 0.2, -0.1, 1.1)), commands)
    more = driven(stage(2, axes_to_actuators=(0.9, 0.2, -0.1, 1.1, 0.0, 0.0, 0.0, 0.0)), commands)
    for a, b in zip(one, more, strict=True):
        assert a.tobytes() == b.tobytes()


def test_a_device_gets_the_same_filter(commands):
    params = build(Params, {"stage.axes_to_actuators": tuple(TAPS.ravel())})
    between = Between((params, params))
    plant = stage(2, axes_to_actuators=tuple(TAPS.ravel()))
    for command in commands[:50]:
        plant.read()
        u = between.actuators(tuple(command))
        told = between.axes(((0.0, 0.0), (0.0, 0.0), u))
        plant.write(tuple(command))
        np.testing.assert_allclose(u, [s.u_applied for s in plant.s[:2]], rtol=1e-12)
        np.testing.assert_allclose([one.u_applied for one in told], command, rtol=1e-9)


def test_a_filter_whose_inverse_is_not_stable_is_refused():
    with pytest.raises(
        ParameterError, match=r"axes_to_actuators: 2 taps, whose inverse has a pole"
    ):
        stage(2, axes_to_actuators=(1.0, 0.0, 0.0, 1.0, 1.2, 0.0, 0.0, 0.3))


def test_limits_are_those_of_each_actuator():
    A = (1.0, 0.5, 1.0, -0.5)
    _, _, u = driven(stage(2, axes_to_actuators=A), [(100.0, 100.0)] * 2)
    # 150 V and 50 V are asked for; 110 V and 50 V are given: 80 V of piston, 60 V of tilt
    np.testing.assert_allclose(u[1], [80.0, 60.0])


LIMIT = {"safety.displacement_max_um": 1.0}


@pytest.mark.parametrize(
    ("own", "reason"),
    [
        ((LIMIT, {}, {}), "x: displacement_range"),
        (({}, {}, LIMIT), "z: displacement_range"),
    ],
)
def test_when_one_axis_trips_all_do_at_the_same_sample(own, reason):
    plant = stage(3, *own)
    for _ in range(100):
        plant.read()
        plant.write((50.0, 60.0, 70.0))
        states = [block.s.gate.state for block in plant.blocks]
        assert len(set(states)) == 1
    assert plant.trip.startswith(reason)
    assert [one.u_applied for one in plant.read()] == [0.0, 0.0, 0.0]


TRIANGLE = (-1.0, -1.0, 5.0, -1.0, -1.0, 5.0)


def test_a_position_outside_the_permitted_area_trips_all():
    plant = stage(2, permitted_um=TRIANGLE)
    for u in np.linspace(0.0, 30.0, 600):
        plant.read()
        plant.write((u, u))
        if plant.trip:
            break
    x, y = (one.y * 1e6 for one in plant.out)
    assert x + y > 4.0
    assert x < 2.3
    assert "permitted_area" in plant.trip
    assert {block.s.gate.state for block in plant.blocks} == {3}


@settings(max_examples=60)
@given(
    st.lists(st.floats(0.0, 2.0 * np.pi), min_size=3, max_size=7, unique=True),
    st.tuples(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5)),
    st.booleans(),
)
def test_inside_agrees_with_another_library(angles, point, clockwise):
    angles = sorted(angles, reverse=clockwise)
    corners = [v for a in angles for v in (np.cos(a), np.sin(a))]
    try:
        found = area(tuple(corners), 2)
    except ParameterError:  # corners that nearly coincide
        return
    polygon = Polygon(found * 1e6, closed=False)
    seen = [bool(polygon.contains_point(point, radius=r)) for r in (1e-9, -1e-9)]
    assert inside(found, point[0] * 1e-6, point[1] * 1e-6) in seen


@pytest.mark.parametrize(
    ("shared", "text"),
    [
        ({"sensors_to_axes": (1.0, 2.0, 2.0, 4.0)}, "singular"),
        ({"axes_to_actuators": (1.0, 2.0, 3.0)}, "give 4, row by row, for 2 axes"),
        ({"cross_talk": (0.5, 0.1, 0.1, 0.0)}, "the diagonal"),
        ({"cross_talk": (0.0,) * 9}, "give 4"),
        ({"modes_K": (0.0,) * 4}, "vibration.type = 'modal'"),
        ({"permitted_um": (0.0, 0.0, 1.0, 0.0)}, "three corners or more"),
        ({"permitted_um": (0.0, 0.0, 2.0, 0.0, 0.5, 0.5, 0.0, 2.0)}, "not convex"),
        ({"permitted_um": (0.0, 1.0, 0.6, -0.8, -0.95, 0.3, 0.95, 0.3, -0.6, -0.8)}, "not convex"),
    ],
)
def test_what_cannot_be_is_refused(shared, text):
    with pytest.raises(ParameterError, match=r"stage\.") as refused:
        stage(2, **shared)
    assert text in str(refused.value)
    assert "\n" not in str(refused.value)


def test_cross_talk_at_a_sensor_with_a_bandwidth_is_refused():
    with pytest.raises(ParameterError, match="bandwidth_hz"):
        stage(2, {"sensor.bandwidth_hz": 1000.0}, {}, cross_talk=(0.0, 0.1, 0.1, 0.0))


def test_a_command_that_is_no_number_is_refused():
    plant = stage(2)
    plant.read()
    with pytest.raises(UnsafeCommand, match="sample 0"):
        plant.write((1.0, np.nan))


def test_delayed_sensors_see_the_cross_talk_as_late(commands):
    late = {"sensor.delay_samples": 3}
    now, _, _ = driven(stage(2, cross_talk=(0.0, 0.1, -0.03, 0.0)), commands)
    y, _, _ = driven(stage(2, late, late, cross_talk=(0.0, 0.1, -0.03, 0.0)), commands)
    np.testing.assert_allclose(y[3:], now[:-3], rtol=1e-12, atol=1e-20)


def test_a_rig_drives_a_simulated_stage_as_it_drives_a_device():
    """What couples the actuators is the stage's; its matrices are in front of the rig."""
    values = {"stage.cross_talk": [1.0, 0.1, -0.2, 1.0], "hysteresis.type": "bouc_wen"}
    bare = tuple(build(Params, values) for _ in "xy")
    turned = {**values, "stage.sensors_to_axes": [1.0, 1.0, 1.0, -1.0]}
    rig = Rig(tuple(build(Params, turned) for _ in "xy"), T_S, axes=AXES[:2])
    alone = Stage([Simulated(own, T_S) for own in bare], AXES[:2])
    rig.connect("test")
    assert rig.gate.activate("test")
    for u in [(10.0, 0.0), (40.0, -5.0), (20.0, 30.0), (0.0, 0.0)]:
        assert rig.step(u, True, (math.nan, math.nan))
        expected = alone.read()
        alone.write(u)
        assert rig.measured.y == tuple(one.y for one in expected)
        assert rig.measured.u_applied == tuple(one.u_applied for one in expected)
    assert alone.read()[1].y != 0.0
