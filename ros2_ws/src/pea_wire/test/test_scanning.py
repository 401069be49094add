"""Messages of a scan's events, as another library reads them."""

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from pea_wire import scanning
from pea_wire.convert import ConversionError

EVENT = np.dtype([("k", "i8"), *((name, "i8") for name in scanning.COLUMNS[1:])])


@pytest.mark.parametrize("count", [0, 1, 3])
def test_another_library_reads_the_table(count):
    found = np.zeros(count, EVENT)
    found["k"], found["direction"], found["line"] = np.arange(count), -1, 7
    data = scanning.encode(found, 50_000)
    store = get_typestore(Stores.ROS2_JAZZY)
    message = store.deserialize_cdr(data, "std_msgs/msg/Int64MultiArray")
    assert message.layout.dim[1].label.split(",") == list(scanning.COLUMNS)
    table = np.asarray(message.data).reshape(-1, 6)
    assert table.tolist() == [[k * 50_000, 0, 0, 7, 0, -1] for k in range(count)]
    np.testing.assert_array_equal(scanning.decode(data), table)
    again = bytes(store.serialize_cdr(message, "std_msgs/msg/Int64MultiArray"))
    assert again.rstrip(b"\0") == data.rstrip(b"\0")


@pytest.mark.parametrize("data", [b"", b"\0\1\0\0", scanning.encode(np.zeros(2, EVENT), 1)[:-8]])
def test_what_is_no_table_is_refused(data):
    with pytest.raises(ConversionError):
        scanning.decode(data)
