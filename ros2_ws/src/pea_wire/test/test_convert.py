import contextlib
import math
import struct

import numpy as np
import pytest
from builtin_interfaces.msg import Duration, Time
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from pea_wire import convert, topics
from pea_wire.convert import (
    POINTS,
    ConversionError,
    JointStateCodec,
    TrajectoryCodec,
    decode_time,
    encode_time,
)

FORMS = convert.forms()
STATE, VOLTAGE, REFERENCE = FORMS.state, FORMS.voltage, FORMS.reference
DISPLACEMENT, DISPLACEMENT_IDEAL = FORMS.displacement, FORMS.displacement_ideal

JAZZY = get_typestore(Stores.ROS2_JAZZY)
FIELDS = ("position", "velocity", "effort")
NS_MAX = (2**31 - 1) * 10**9 + 999_999_999

stamps = st.integers(0, NS_MAX)
numbers = st.floats(allow_nan=False)
axes = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9)
several = st.lists(axes, min_size=1, max_size=3, unique=True).map(tuple)
joint_codecs = st.builds(
    JointStateCodec, several, position=st.booleans(), velocity=st.booleans(), effort=st.booleans()
)
own_codecs = st.sampled_from([STATE, VOLTAGE, DISPLACEMENT, DISPLACEMENT_IDEAL])


def stamp_of(message):
    return message.sec * 10**9 + message.nanosec


@st.composite
def joint_messages(draw):
    """A codec of any axes and fields, a stamp, and the values that it carries."""
    codec = draw(joint_codecs)
    n = len(codec.axes)
    value = numbers if n == 1 else st.tuples(*[numbers] * n)
    return codec, draw(stamps), draw(st.tuples(*[value] * sum(codec.carries)))


@st.composite
def trajectories(draw):
    """A codec of any axes, stamp, period and points."""
    names, n = draw(several), draw(st.integers(0, 5))
    size = 3 * len(names)
    points = draw(st.lists(st.tuples(*[numbers] * size), min_size=n, max_size=n))
    period = draw(st.integers(1, 2 * 10**9))
    return TrajectoryCodec(names), draw(stamps), period, np.array(points).reshape(n, size)


def flat(value):
    """Numbers of a value, of one axis or several."""
    return list(value) if isinstance(value, tuple) else [value]


@st.composite
def foreign_joint_states(draw):
    """What another node may publish: a frame, several axes, each array full or empty."""
    names = draw(st.lists(axes.filter(lambda a: a != "x"), max_size=4, unique=True))
    at = draw(st.integers(0, len(names)))
    names.insert(at, "x")
    message = JointState()
    message.header.frame_id = draw(axes)
    message.header.stamp.sec = draw(st.integers(-(2**31), 2**31 - 1))
    message.header.stamp.nanosec = draw(st.integers(0, 999_999_999))
    message.name = names
    expected = []
    for field in FIELDS:
        values = []
        if draw(st.booleans()):
            values = draw(st.lists(numbers, min_size=len(names), max_size=len(names)))
        setattr(message, field, values)
        expected.append(values[at] if values else math.nan)
    return message, expected


@st.composite
def foreign_trajectories(draw):
    """What another node may publish: a frame, several axes, efforts, uneven times."""
    names = draw(st.lists(axes.filter(lambda a: a != "x"), max_size=2, unique=True))
    at = draw(st.integers(0, len(names)))
    names.insert(at, "x")
    message = JointTrajectory()
    message.header.frame_id = draw(axes)
    message.joint_names = names
    times, expected = [], []
    for _ in range(draw(st.integers(0, 3))):
        values = [
            draw(st.lists(numbers, min_size=len(names), max_size=len(names))) for _ in range(3)
        ]
        time = draw(st.integers(-(2**31) * 10**9, NS_MAX))
        message.points.append(
            JointTrajectoryPoint(
                positions=values[0],
                velocities=values[1],
                accelerations=values[2],
                effort=draw(st.lists(numbers, max_size=2)),
                time_from_start=Duration(sec=time // 10**9, nanosec=time % 10**9),
            )
        )
        times.append(time)
        expected.append([v[at] for v in values])
    return message, times, expected


def with_rosbags(message):
    """The bytes of `message` from a serialiser of another make."""
    other = _as_rosbags(message)
    return bytes(JAZZY.serialize_cdr(other, other.__msgtype__))


def _as_rosbags(value):
    if hasattr(value, "get_fields_and_field_types"):
        kind = JAZZY.types[f"{type(value).__module__.split('.')[0]}/msg/{type(value).__name__}"]
        fields = value.get_fields_and_field_types()
        return kind(**{f: _as_rosbags(getattr(value, f)) for f in fields})
    if isinstance(value, list):
        return [_as_rosbags(v) for v in value]
    return np.array(value) if hasattr(value, "typecode") else value


SERIALISERS = pytest.mark.parametrize("serialise", [serialize_message, with_rosbags])


@given(joint_messages())
def test_joint_state_round_trip(case):
    codec, stamp, values = case

    decoded = codec.decode(codec.encode(stamp, *values))

    rest = iter(values)
    none = math.nan if len(codec.axes) == 1 else (math.nan,) * len(codec.axes)
    expected = [next(rest) if carried else none for carried in codec.carries]
    assert decoded.stamp == stamp
    np.testing.assert_array_equal(decoded[1:], expected)


@given(joint_messages())
def test_rclpy_reads_joint_state(case):
    codec, stamp, values = case

    message = deserialize_message(codec.encode(stamp, *values), JointState)

    assert stamp_of(message.header.stamp) == stamp
    assert message.name == list(codec.axes)
    assert message.header.frame_id == ""
    read = [list(getattr(message, field)) for field in FIELDS]
    assert [len(field) for field in read] == [len(codec.axes) * c for c in codec.carries]
    assert [v for field in read for v in field] == [v for value in values for v in flat(value)]


@given(joint_messages())
def test_rosbags_reads_and_writes_same_joint_state(case):
    codec, stamp, values = case
    data = codec.encode(stamp, *values)

    message = JAZZY.deserialize_cdr(data, topics.JOINT_STATE)

    assert message.name == list(codec.axes)
    read = np.concatenate([getattr(message, f) for f in FIELDS]).tolist()
    assert read == [v for value in values for v in flat(value)]
    assert bytes(JAZZY.serialize_cdr(message, topics.JOINT_STATE)) == data


@given(joint_messages(), st.lists(stamps, max_size=4))
def test_encode_many_equals_encode(case, many):
    codec, _, values = case
    columns = [np.array([v] * len(many)) for v in values]
    if len(codec.axes) > 1:
        columns = [column.reshape(len(many), len(codec.axes)) for column in columns]

    rows = codec.encode_many(np.array(many, np.int64), *columns)

    assert [row.tobytes() for row in rows] == [codec.encode(t, *values) for t in many]


def test_the_codecs_of_a_loop_are_the_same_however_its_axes_are_given():
    assert convert.forms() is convert.forms(("x",))
    assert convert.forms(("x", "y")) is convert.forms(("x", "y")) is not convert.forms()


def test_encode_keeps_bits_of_nan():
    payload = struct.unpack("<d", struct.pack("<Q", 0x7FF8_0000_0000_BEEF))[0]

    decoded = STATE.decode(STATE.encode(0, 1.0, payload, -0.0))

    assert struct.pack("<d", decoded.velocity) == struct.pack("<d", payload)
    assert math.copysign(1.0, decoded.effort) == -1.0


@SERIALISERS
@given(case=foreign_joint_states())
def test_joint_state_of_other_publishers(serialise, case):
    message, expected = case

    decoded = STATE.decode(serialise(message))

    assert decoded.stamp == stamp_of(message.header.stamp)
    np.testing.assert_array_equal(decoded[1:], expected)


@given(foreign_joint_states())
def test_joint_state_without_the_axis_is_refused(case):
    message, _ = case

    with pytest.raises(ConversionError, match=r"name: .*: must hold the axis 'other axis'"):
        JointStateCodec(("other axis",), position=True).decode(serialize_message(message))


def test_big_endian_joint_state():
    data = b"\0\0\0\0" + struct.pack(">iI", 3, 500) + struct.pack(">I4x", 1)
    data += struct.pack(">II2s2xI", 1, 2, b"x", 1) + bytes(-(8 + 8 + 16) % 8)
    data += struct.pack(">dIId", 1.5, 0, 1, -2.5)

    assert DISPLACEMENT.decode(data)[:2] == (3_000_000_500, 1.5)
    assert DISPLACEMENT.decode(data).effort == -2.5


@given(trajectories())
def test_trajectory_round_trip(case):
    codec, stamp, period, points = case

    read, times, values = codec.decode(codec.encode(stamp, period, points))

    assert read == stamp
    assert times.tolist() == [k * period for k in range(len(points))]
    assert values.tobytes() == points.tobytes()


@given(trajectories())
def test_rclpy_reads_trajectory(case):
    codec, stamp, period, points = case

    message = deserialize_message(codec.encode(stamp, period, points), JointTrajectory)

    assert stamp_of(message.header.stamp) == stamp
    assert message.joint_names == list(codec.axes)
    for k, (point, row) in enumerate(zip(message.points, points, strict=True)):
        read = [point.positions, point.velocities, point.accelerations]
        assert np.transpose(read).ravel().tolist() == row.tolist()
        assert len(point.effort) == 0
        assert stamp_of(point.time_from_start) == k * period


@given(trajectories())
def test_rosbags_reads_and_writes_same_trajectory(case):
    codec, stamp, period, points = case
    data = codec.encode(stamp, period, points)

    message = JAZZY.deserialize_cdr(data, topics.JOINT_TRAJECTORY)

    assert [p.positions.tolist() for p in message.points] == points[:, ::3].tolist()
    assert bytes(JAZZY.serialize_cdr(message, topics.JOINT_TRAJECTORY)) == data


@SERIALISERS
@given(case=foreign_trajectories())
def test_trajectory_of_other_publishers(serialise, case):
    message, times, expected = case

    stamp, read, points = REFERENCE.decode(serialise(message))

    assert stamp == stamp_of(message.header.stamp)
    assert read.tolist() == times
    assert points.tolist() == expected


@pytest.mark.parametrize("field", ["positions", "velocities", "accelerations"])
def test_trajectory_point_without_a_derivative_is_refused(field):
    point = {"positions": [1.0], "velocities": [2.0], "accelerations": [3.0], field: []}
    message = JointTrajectory(joint_names=["x"], points=[JointTrajectoryPoint(**point)])

    with pytest.raises(ConversionError, match=r"points\[0\]: must hold position"):
        REFERENCE.decode(serialize_message(message))


def test_trajectory_with_too_few_axes_in_its_points_is_refused():
    point = JointTrajectoryPoint(positions=[1.0], velocities=[2.0], accelerations=[3.0])
    message = JointTrajectory(joint_names=["other", "x"], points=[point, point])

    with pytest.raises(ConversionError, match=r"points\[0\]: must hold position"):
        REFERENCE.decode(serialize_message(message))


def test_a_running_loop_takes_shorter_chunks_than_a_recording_holds():
    data = REFERENCE.encode(0, 1, np.zeros((POINTS + 1, 3)))

    assert len(REFERENCE.decode(data)[1]) == POINTS + 1
    assert len(REFERENCE.receive(REFERENCE.encode(0, 1, np.zeros((POINTS, 3))))[1]) == POINTS
    with pytest.raises(ConversionError, match=f"points: {POINTS + 1} of them: must be at most"):
        REFERENCE.receive(data)


def test_trajectory_that_claims_billions_of_points_is_refused():
    data = bytearray(REFERENCE.encode(0, 1, np.zeros((1, 3))))
    data[-64:-60] = b"\xff\xff\xff\xff"  # its one point takes 60 bytes here

    with pytest.raises(ConversionError, match="points: 4294967295 of them: must be at most"):
        REFERENCE.decode(bytes(data))


@given(stamps)
def test_time_round_trip(stamp):
    data = encode_time(stamp)

    assert decode_time(data) == stamp
    assert stamp_of(deserialize_message(data, Time)) == stamp
    assert serialize_message(deserialize_message(data, Time)) == data


@given(joint_messages(), st.data())
def test_truncated_joint_state_is_refused(case, data):
    codec, stamp, values = case
    message = codec.encode(stamp, *values)

    with pytest.raises(ConversionError):
        codec.decode(message[: data.draw(st.integers(0, len(message) - 1))])


@given(trajectories(), st.data())
def test_truncated_trajectory_is_refused(case, data):
    codec, *rest = case
    message = codec.encode(*rest)

    with pytest.raises(ConversionError):
        codec.decode(message[: data.draw(st.integers(0, len(message) - 1))])


def test_truncated_time_is_refused():
    with pytest.raises(ConversionError):
        decode_time(encode_time(5)[:-1])


@st.composite
def damaged(draw, messages):
    """A message with some bytes replaced, or bytes of no sense at all."""
    data = bytearray(draw(st.one_of(st.binary(max_size=120), messages)))
    for _ in range(draw(st.integers(0, 4)) if data else 0):
        data[draw(st.integers(0, len(data) - 1))] = draw(st.sampled_from([0, 1, 9, 127, 255]))
    return bytes(data)


@given(own_codecs, damaged(foreign_joint_states().map(lambda m: serialize_message(m[0]))))
def test_damaged_joint_state_raises_conversion_error_only(codec, data):
    with contextlib.suppress(ConversionError):
        assert isinstance(codec.decode(data).stamp, int)


@given(damaged(trajectories().map(lambda t: t[0].encode(*t[1:]))))
def test_damaged_trajectory_raises_conversion_error_only(data):
    with contextlib.suppress(ConversionError):
        _, times, points = REFERENCE.decode(data)
        assert len(times) == len(points)


def test_name_that_is_no_text_is_refused():
    data = STATE.encode(0, 1.0, 2.0, 3.0).replace(b"x\0", b"\xff\0")

    with pytest.raises(ConversionError, match="no UTF-8"):
        STATE.decode(data)


def test_points_one_a_message_are_those_of_the_message_by_message_way():
    stamps = np.array([5, 1_000_000_007, 3_000_000_000])
    points = np.random.default_rng(0).normal(size=(3, 3))
    each = FORMS.reference.encode_each(stamps, *points.T)
    for i, stamp in enumerate(stamps.tolist()):
        alone = FORMS.reference.encode(stamp, 50_000, points[i : i + 1])
        assert each[i].tobytes() == alone
    np.testing.assert_array_equal(FORMS.reference.decode_each(each.tobytes()), points[:, 0])
    with pytest.raises(convert.ConversionError):
        FORMS.reference.decode_each(each.tobytes()[:-1])
