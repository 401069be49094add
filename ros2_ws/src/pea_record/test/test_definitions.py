import sys

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pea_record.definitions import DefinitionError, schema_text, type_hash
from pea_wire.topics import RECORDED_TOPICS

TYPES = sorted({topic.type for topic in RECORDED_TOPICS})
TYPES += ["sensor_msgs/msg/PointCloud2", "rcl_interfaces/msg/ParameterDescriptor"]


@pytest.fixture
def nothing_known():
    """Forget what other tests have looked up."""
    schema_text.cache_clear()
    type_hash.cache_clear()


@pytest.mark.parametrize("name", TYPES)
def test_schema_alone_gives_the_hash(name):
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(schema_text(name), name))

    assert store.hash_rihs01(name) == type_hash(name)


def test_each_dependency_stands_once():
    text = schema_text("rcl_interfaces/msg/ParameterEvent")

    headings = [line for line in text.splitlines() if line.startswith("MSG: ")]
    assert sorted(headings) == [
        "MSG: builtin_interfaces/Time",
        "MSG: rcl_interfaces/Parameter",
        "MSG: rcl_interfaces/ParameterValue",
    ]


@pytest.mark.parametrize("name", ["no_such_msgs/msg/JointState", "sensor_msgs/msg/NoSuchState"])
@pytest.mark.parametrize("look_up", [schema_text, type_hash])
def test_unknown_type_is_refused(name, look_up):
    with pytest.raises(DefinitionError, match=f"no definition of {name}"):
        look_up(name)


@pytest.mark.usefixtures("nothing_known")
def test_error_says_what_to_do_without_a_set_up(monkeypatch):
    monkeypatch.delenv("AMENT_PREFIX_PATH")

    with pytest.raises(DefinitionError, match="source the ROS 2 set-up first"):
        schema_text("lab_msgs/msg/Stage")


@pytest.mark.parametrize("name", TYPES)
def test_without_ros_the_types_of_jazzy_are_known(name, monkeypatch):
    installed = type_hash(name)
    for look_up in (schema_text, type_hash):
        look_up.cache_clear()
    monkeypatch.setitem(sys.modules, "ament_index_python.packages", None)

    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(schema_text(name), name))
    assert store.hash_rihs01(name) == type_hash(name) == installed
    for look_up in (schema_text, type_hash):
        look_up.cache_clear()
