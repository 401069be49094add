import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rcl_interfaces.msg import Parameter, ParameterEvent, ParameterType, ParameterValue
from rclpy.parameter import Parameter as RclpyParameter
from rclpy.parameter import parameter_value_to_python
from rclpy.serialization import deserialize_message, serialize_message

from pea_wire import events
from pea_wire.convert import ConversionError

texts = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9)
floats = st.floats(allow_nan=False)
ints = st.integers(-(2**63), 2**63 - 1)
values = st.one_of(
    st.booleans(),
    ints,
    floats,
    texts,
    *(st.lists(kind, min_size=1, max_size=3).map(tuple) for kind in (st.booleans(), ints, floats)),
    st.lists(texts, min_size=1, max_size=3).map(tuple),
)
changes = st.dictionaries(texts, values, max_size=4)
stamps = st.integers(0, 2**31 * 10**9 - 1)


def plain(parameters):
    found = {p.name: parameter_value_to_python(p.value) for p in parameters}
    return {
        n: tuple(v) if hasattr(v, "__len__") and not isinstance(v, str) else v
        for n, v in found.items()
    }


@given(stamp=stamps, changed=changes)
def test_rclpy_reads_what_is_encoded(stamp, changed):
    message = deserialize_message(events.encode(stamp, "/pea/controller", changed), ParameterEvent)

    assert message.stamp.sec * 10**9 + message.stamp.nanosec == stamp
    assert message.node == "/pea/controller"
    assert plain(message.changed_parameters) == changed
    assert not message.new_parameters
    assert not message.deleted_parameters


@given(stamp=stamps, new=changes, changed=changes)
def test_what_rclpy_writes_is_decoded(stamp, new, changed):
    message = ParameterEvent(node="/pea/observer")
    message.stamp.sec, message.stamp.nanosec = divmod(stamp, 10**9)
    for there, given_ in ((message.new_parameters, new), (message.changed_parameters, changed)):
        there += [RclpyParameter(n, value=v).to_parameter_msg() for n, v in given_.items()]

    event = events.decode(serialize_message(message))

    assert event == (stamp, "/pea/observer", new, changed)


@pytest.mark.parametrize("value", [0.1, -0.0, 5e-324, math.pi, math.inf])
def test_every_bit_of_a_number_comes_back(value):
    found = events.decode(events.encode(0, "n", {"P": value})).changed["P"]

    assert (found, math.copysign(1, found)) == (value, math.copysign(1, value))


def test_value_that_is_not_set_is_none():
    message = ParameterEvent(changed_parameters=[Parameter(name="P", value=ParameterValue())])

    assert events.decode(serialize_message(message)).changed == {"P": None}


def test_bytes_come_as_numbers():
    value = ParameterValue(type=ParameterType.PARAMETER_BYTE_ARRAY, byte_array_value=[b"\1", b"\2"])
    message = ParameterEvent(changed_parameters=[Parameter(name="b", value=value)])

    assert events.decode(serialize_message(message)).changed == {"b": (1, 2)}


@given(end=st.integers(0, 100))
def test_message_that_ends_early_is_refused(end):
    data = events.encode(0, "/pea/observer", {"P": 1.0, "text": "abc"})

    with pytest.raises(ConversionError):
        events.decode(data[: min(end, len(data) - 5)])
