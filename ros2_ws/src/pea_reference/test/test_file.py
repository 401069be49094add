"""The reference from a file."""

import numpy as np
import pytest

from pea_core.block import Signal
from pea_core.params import ParameterError, build
from pea_core.signals import Reference
from pea_reference.model import file
from pea_reference.model.file import Params, design, output

T_END = 0.02


@pytest.fixture
def signal(tmp_path):
    def of(t, w, T_s=1e-6, head="", **values):
        path = tmp_path / "w.csv"
        path.write_text(head + "".join(f"{a!r},{b!r}\n" for a, b in zip(map(float, t), w.tolist())))
        return Signal(file, build(file.Params, {"path": str(path), **values}), T_s)

    return of


@pytest.fixture
def text(tmp_path):
    def of(content, name="w.csv", **values):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return Signal(file, build(file.Params, {"path": str(path), **values}), 50e-6)

    return of


def uneven(n=30):
    s = np.linspace(0.0, 1.0, n)
    return T_END * (s + 0.08 * np.sin(2 * np.pi * s))


def minimum_jerk(s):
    return 10 * s**3 - 15 * s**4 + 6 * s**5


def test_points_are_met_exactly(signal):
    t = np.round(uneven(), 6)
    w = np.random.default_rng(1).normal(size=t.size)
    through = signal(t, w)
    got = [through.at(round(a / 1e-6)).w * 1e6 for a in t]
    np.testing.assert_allclose(got, w, atol=1e-8)


def test_quintic_at_rest_reproduces_a_minimum_jerk_move(signal):
    t = uneven()
    move = signal(t, 8.0 * minimum_jerk(t / T_END))
    s = np.arange(0, 20000, 371) * 1e-6 / T_END
    got = np.array([move.at(k) for k in range(0, 20000, 371)])
    w_ddot = 8e-6 / T_END**2 * (60 * s - 180 * s**2 + 120 * s**3)
    np.testing.assert_allclose(got[:, 0], 8e-6 * minimum_jerk(s), atol=1e-15)
    np.testing.assert_allclose(got[:, 1], 8e-6 / T_END * 30 * (s * (1 - s)) ** 2, atol=1e-11)
    np.testing.assert_allclose(got[:, 2], w_ddot, atol=1e-6)


def test_cubic_at_rest_reproduces_a_smooth_step(signal):
    s = uneven() / T_END
    move = signal(s * T_END, 8.0 * (3 * s**2 - 2 * s**3), spline="cubic")
    x = 0.3
    w, w_dot, w_ddot = move.at(6000)
    assert w == pytest.approx(8e-6 * (3 * x**2 - 2 * x**3), rel=1e-9)
    assert w_dot == pytest.approx(8e-6 / T_END * 6 * x * (1 - x), rel=1e-9)
    assert w_ddot == pytest.approx(8e-6 / T_END**2 * (6 - 12 * x), rel=1e-7)


def test_free_ends_reproduce_a_polynomial_that_ends_moving(signal):
    t = uneven(12)
    c = np.array([3.0, -2.0, 5.0, 1.0, -4.0, 2.0])
    free = signal(t, np.polyval(c, t / T_END), ends="free")
    for k in (0, 5000, 19999):
        w, w_dot, w_ddot = free.at(k)
        s = k * 1e-6 / T_END
        assert w * 1e6 == pytest.approx(np.polyval(c, s), rel=1e-9)
        assert w_dot * 1e6 * T_END == pytest.approx(np.polyval(np.polyder(c), s), rel=1e-7)
        assert w_ddot * 1e6 * T_END**2 == pytest.approx(np.polyval(np.polyder(c, 2), s), rel=1e-5)


def test_periodic_sine_repeats_with_its_derivatives(signal):
    t = np.linspace(0.0, T_END, 41)
    w = 5.0 - 5.0 * np.cos(2 * np.pi * t / T_END)
    w[-1] = w[0]
    one = signal(t, w, ends="periodic")
    omega = 2 * np.pi / T_END
    for k in (0, 777, 19999, 20000, 7 * 20000 + 3333):
        angle = omega * k * 1e-6
        assert one.at(k).w == pytest.approx(5e-6 - 5e-6 * np.cos(angle), abs=1e-12)
        assert one.at(k).w_dot == pytest.approx(5e-6 * omega * np.sin(angle), abs=1e-8)
        assert one.at(k).w_ddot == pytest.approx(5e-6 * omega**2 * np.cos(angle), abs=1e-4)


@pytest.mark.parametrize("spline", ["cubic", "quintic"])
@pytest.mark.parametrize("ends", ["rest", "free", "periodic"])
def test_derivatives_between_points(signal, differences_agree, spline, ends):
    w = np.random.default_rng(2).normal(size=30)
    w[-1] = w[0]
    wild = signal(np.linspace(0.0, T_END, 30), w, spline=spline, ends=ends)
    for k in (300, 8000, 19700):
        differences_agree(wild, k, rel=1e-6)


@pytest.mark.parametrize(("spline", "tolerance"), [("cubic", 0.02), ("quintic", 0.02)])
def test_points_are_joints_continuous_to_the_second_derivative(
    signal, is_continuous, spline, tolerance
):
    w = np.random.default_rng(2).normal(size=21)
    wild = signal(np.linspace(0.0, T_END, 21), w, spline=spline)
    peak = max(abs(wild.at(k).w_ddot) for k in range(0, 20000, 10))
    for k in (1000, 10000, 19000):
        is_continuous(wild, k)
        assert abs(wild.at(k + 1).w_ddot - wild.at(k - 1).w_ddot) < tolerance * peak


@pytest.mark.parametrize("spline", ["cubic", "quintic"])
def test_rest_ends_without_a_jump_and_holds_the_last_value(signal, is_continuous, spline):
    w = np.random.default_rng(2).normal(size=21)
    wild = signal(np.linspace(0.0, T_END, 21), w, spline=spline)
    is_continuous(wild, 20000)
    assert wild.at(0).w_dot == pytest.approx(0.0, abs=1e-12)
    assert wild.at(10**10) == Reference(w[-1] * 1e-6, 0.0, 0.0)


def test_time_may_start_anywhere_and_a_head_line_is_skipped(signal):
    t = np.linspace(0.0, T_END, 10)
    w = minimum_jerk(t / T_END)
    late = signal(t + 100.0, w, head="time,w\n")
    assert late.at(7000).w == pytest.approx(signal(t, w).at(7000).w, rel=1e-9)


def test_many_fine_points_keep_their_derivatives(signal):
    t = np.arange(20001) * 50e-6
    one = signal(t, 5.0 - 5.0 * np.cos(2 * np.pi * 10.0 * t), T_s=50e-6)
    omega = 20 * np.pi
    angle = omega * 7777 * 50e-6
    assert one.at(7777).w_dot == pytest.approx(5e-6 * omega * np.sin(angle), rel=1e-6)
    assert one.at(7777).w_ddot == pytest.approx(5e-6 * omega**2 * np.cos(angle), rel=1e-4)


GOOD = "0,0\n1,1\n2,2\n3,3\n4,4\n5,5\n"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("0,0\n0.2,1\n0.1,2\n", r"time must rise .*, but line 3 has 0.1 s after 0.2 s"),
        ("0,0\n0.2,1\n0.2,2\n", r"time must rise"),
        ("0,0\n1,1\n2,0\n", r"3 points are too few, a quintic spline needs 6"),
        ("", r"has no line of two numbers"),
        (GOOD + "6,six\n", r"line 7 must be two numbers"),
        (GOOD + "6,1,2\n", r"line 7 must be two numbers"),
        (GOOD + "6,nan\n", r"line 7 is not finite"),
        ("0.000000,\n" + GOOD, r"line 1 must be two numbers"),
        (b"\x00\x01", r"is no text of separated values"),
    ],
)
def test_bad_file_is_one_clear_line(text, content, words):
    with pytest.raises(ParameterError, match=r"^path = '.*w\.csv': .*" + words) as error:
        text(content)
    assert "\n" not in str(error.value)


def test_missing_file_is_named():
    with pytest.raises(ParameterError, match=r"path = '/no/w\.csv': No such file"):
        Signal(file, file.Params(path="/no/w.csv"), 50e-6)


def test_no_file_is_named():
    with pytest.raises(ParameterError, match="path = '': give a CSV file"):
        Signal(file, file.Params(), 50e-6)


def test_unknown_kind_of_file_names_the_known(text):
    with pytest.raises(ParameterError, match=r"cannot read '.xls' files, give a .csv"):
        text(GOOD, name="w.xls")


def test_rounding_in_the_text_of_a_periodic_file_is_no_difference(text):
    t = [k / 16 for k in range(17)]
    w = [2.5 + np.sin(2 * np.pi * a + 0.1) for a in t]
    w[-1] = np.nextafter(w[0], 9.0)
    lines = [f"{a},{x!r}\n" for a, x in zip(t, map(float, w))]
    one = text("".join(lines), ends="periodic")
    assert one.at(0) == one.at(20000)


def test_periodic_file_must_end_where_it_starts(text):
    with pytest.raises(ParameterError, match="ends at 5 um, but starts at 0 um"):
        text(GOOD, ends="periodic")


@pytest.mark.parametrize("ends", ["rest", "free", "periodic"])
@pytest.mark.parametrize(("spline", "points"), [("cubic", 4), ("quintic", 6)])
def test_the_fewest_points_will_do(text, ends, spline, points):
    lines = [f"{i},{(i % (points - 1)) ** 2}\n" for i in range(points)]
    one = text("".join(lines), ends=ends, spline=spline)
    assert one.at(20000).w == pytest.approx(1e-6, abs=1e-12)


@pytest.fixture
def bag(tmp_path):
    """A bag of another writer: joint states of two axes and a trajectory, nothing else."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    kind = store.types
    Time, Header = kind["builtin_interfaces/msg/Time"], kind["std_msgs/msg/Header"]
    State = kind["sensor_msgs/msg/JointState"]
    Trajectory = kind["trajectory_msgs/msg/JointTrajectory"]
    Point = kind["trajectory_msgs/msg/JointTrajectoryPoint"]
    Duration = kind["builtin_interfaces/msg/Duration"]
    none = np.array([])
    path = tmp_path / "bag"
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        states = writer.add_connection("/stage", State.__msgtype__, typestore=store)
        broken = writer.add_connection("/broken", State.__msgtype__, typestore=store)
        plans = writer.add_connection("/plan", Trajectory.__msgtype__, typestore=store)
        for k in range(20):
            header = Header(Time(3, k * 1_000_000), "")
            state = State(header, ["x", "z"], np.array([k * 1e-7, 9.0]), none, none)
            writer.write(states, k, store.serialize_cdr(state, State.__msgtype__))
            state.position[0] = np.nan if k == 7 else k
            writer.write(broken, k, store.serialize_cdr(state, State.__msgtype__))
        points = [
            Point(np.array([j * 2e-6]), none, none, none, Duration(0, j * 500)) for j in range(8)
        ]
        plan = Trajectory(Header(Time(1, 0), ""), ["x"], points)
        writer.write(plans, 0, store.serialize_cdr(plan, Trajectory.__msgtype__))
    return path


def test_bag_of_joint_states_is_a_reference(bag):
    c = design(Params(path=str(bag), topic="/stage", ends="free"), T_s=1e-3)
    w = [output(c, k).w for k in range(20)]
    np.testing.assert_allclose(w, np.arange(20) * 1e-7, atol=1e-18)


def test_bag_of_a_trajectory_is_a_reference(bag):
    c = design(Params(path=str(bag), topic="/plan", ends="free"), T_s=5e-7)
    np.testing.assert_allclose([output(c, k).w for k in range(8)], np.arange(8) * 2e-6, atol=1e-17)


def test_topic_that_the_bag_lacks_names_those_it_has(bag):
    with pytest.raises(ParameterError, match="no positions on topic '/stge', did you mean /stage"):
        design(Params(path=str(bag), topic="/stge"), T_s=1e-3)


def test_bag_with_a_position_that_is_no_number_is_refused(bag):
    with pytest.raises(ParameterError, match="a position on /broken is not finite"):
        design(Params(path=str(bag), topic="/broken"), T_s=1e-3)


def test_directory_that_is_no_bag_is_one_line(tmp_path):
    with pytest.raises(ParameterError, match="no readable bag"):
        design(Params(path=str(tmp_path)), T_s=1e-3)
