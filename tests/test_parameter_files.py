"""Parameter files mean the same to the command line, to presets and to ROS's own parser."""

from pathlib import Path
from typing import Any

import pytest
import rclpy
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rclpy.node import Node

from pea_core import config, parameter_file
from pea_core.params import ParameterError
from pea_experiment import experiments
from pea_experiment.experiment import SCHEMAS

NODE = "/pea/controller"


def told_to_ros(path: Path, node: str = NODE) -> dict[str, Any] | None:
    """What a real node of that name gets from a file; None where ROS refuses the file."""
    context = rclpy.Context()
    try:
        rclpy.init(args=["--ros-args", "--params-file", str(path)], context=context)
    except Exception:
        return None
    space, _, name = node.rpartition("/")
    try:
        made = Node(
            name,
            namespace=space,
            context=context,
            enable_rosout=False,
            start_parameter_services=False,
            allow_undeclared_parameters=True,
        )
        found = {n: p.value for n, p in made._parameter_overrides.items()}
        made.destroy_node()
    finally:
        context.try_shutdown()
    return {n: list(v) if hasattr(v, "tolist") else v for n, v in found.items()}


def told_to_us(path: Path, node: str = NODE) -> dict[str, Any] | None:
    """What we read there; None where we refuse it."""
    try:
        return parameter_file.values_of(parameter_file.sections(path), node)
    except ParameterError:
        return None


def same(one: Any, other: Any) -> bool:
    """Whether two values are equal and of one type; ROS has no type for an empty list."""
    if one is None or other is None:
        return (one or other or []) == []
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(same, one, other))
    return type(one) is type(other) and (one == other or (one != one and other != other))


SECTIONS = (
    "/pea/controller",
    "pea/controller",
    "/**/controller",
    "/*/controller",
    "/pea/*",
    "/pea/**",
    "/**",
    "/*",
    "/**/*",
    "**",
    "controller",
    "/controller",
    "/stage1/controller",
    "/pea/stage1/controller",
    "/pea/plant",
    "/pe*/controller",
    "/pea//controller",
)

PLAIN = (Path(__file__).parent / "scalars.txt").read_text().split()
GOOD = [p for p in PLAIN if p.isalnum() and parameter_file.text_of(p)]
GOOD += ["1.5", "1e5", "1E-8", "3", "-0.0", "Y", "off", "'Y'", '"1E5"']
GOOD += ["[1, 2]", "[Y, no]", "[a, b]"]

scalars = st.one_of(
    st.sampled_from(PLAIN),
    st.from_regex(r"[+-]?[0-9]{1,3}(\.[0-9]{0,2})?([eE][+-]?[0-9]{1,3})?", fullmatch=True),
    st.text(alphabet="0123456789.+-eExXbo_:yYnNaAfFtTrRuU", min_size=1, max_size=6),
    st.builds("!!{} {}".format, st.sampled_from(("str", "int", "bool")), st.sampled_from(PLAIN)),
)
GOOD = [p for p in PLAIN if p.isalnum() and parameter_file.text_of(p)]
GOOD += [
    "1.5",
    "1e5",
    "1E-8",
    "3",
    "-0.0",
    "Y",
    "off",
    "'Y'",
    '"1E5"',
    "[1, 2]",
    "[Y, no]",
    "[a, b]",
]
values = st.one_of(
    st.sampled_from(GOOD),
    st.sampled_from(GOOD),
    scalars,
    st.lists(scalars, max_size=3).map(lambda items: f"[{', '.join(items)}]"),
    st.sampled_from(("", "[0, 1.5, 3]", "[[1]]", "{a: 1, b: {c: 2.5}}", "{}", "[{a: 1}]")),
)
names = st.sampled_from(("m", "P", "a.b", "on", "1", "preset", '"q"'))


some_sections = st.sampled_from(SECTIONS[:-2] + SECTIONS)


@st.composite
def bodies(draw: st.DrawFn, indent: str) -> str:
    """Names and values of a section."""
    found = draw(st.dictionaries(names, values, min_size=1, max_size=3))
    return "".join(f"{indent}{name}: {value}\n" for name, value in found.items())


@st.composite
def files(draw: st.DrawFn) -> str:
    """A file with some sections, flat or one name inside the other."""
    text = ""
    for section in draw(st.lists(some_sections, min_size=1, max_size=3, unique=True)):
        parts = [section]
        if draw(st.booleans()) and section.count("/") > 1 and "//" not in section:
            parts = section.strip("/").split("/")
        for depth, part in enumerate(parts):
            text += f"{'  ' * depth}{part}:\n"
        indent = "  " * len(parts)
        text += f"{indent}ros__parameters:\n" + draw(bodies(indent + "  "))
    return text


@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
@given(files())
def test_what_we_take_from_a_file_is_what_ros_takes(tmp_path_factory, text):
    path = tmp_path_factory.mktemp("file") / "generated.yaml"
    path.write_text(text)
    ours = told_to_us(path)
    if ours is None:
        return
    theirs = told_to_ros(path)
    assert theirs is not None, text
    assert ours.keys() == theirs.keys(), text
    assert all(same(ours[name], theirs[name]) for name in ours), (text, ours, theirs)


@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.one_of(st.text(max_size=8), st.sampled_from(GOOD), st.sampled_from(PLAIN)))
def test_text_that_we_write_is_text_to_ros(tmp_path_factory, text):
    path = tmp_path_factory.mktemp("file") / "written.yaml"
    if not text.isprintable() or "\0" in text:
        return
    config.write(path, {"controller": {"axis": text, "P": 1e-8, "taps": (0.0, 1.5)}})
    expected = {"axis": text, "P": 1e-8, "taps": [0.0, 1.5]}
    assert told_to_us(path) == told_to_ros(path) == expected


SAME = {
    "without a slash": ("controller: {ros__parameters: {m: 1.0}}", None),
    "of ROS's root": ("/controller: {ros__parameters: {m: 1.0}}", None),
    "of another stage": ("/stage1/controller: {ros__parameters: {m: 1.0}}", None),
    "any namespace": ("/**/controller: {ros__parameters: {m: 7.0}}", 7.0),
    "any node here": ("/pea/*: {ros__parameters: {T_s: 5.0e-5}}", 5000.0),
    "of one of them": ("/pea/*: {ros__parameters: {m: 7.0}}", 7.0),
    "of one of any": ("/**: {ros__parameters: {m: 7.0, sensor: {noise_nm: 1.0}}}", 7.0),
    "of none": ("/**: {ros__parameters: {m: 7.0, mm: 7.0}}", None),
    "nested": ("pea: {controller: {ros__parameters: {m: 7.0}}}", 7.0),
    "one of two stages": (
        "{/pea/controller: {ros__parameters: {m: 7.0}}, /s/controller: {ros__parameters: {m: 1}}}",
        7.0,
    ),
    "of another stage and of all": (
        "{/**: {ros__parameters: {T_s: 5.0e-5}}, /s/controller: {ros__parameters: {m: 1.0}}}",
        None,
    ),
    "time of a simulator": ("/pea/controller: {ros__parameters: {use_sim_time: true}}", None),
    "no such time": ("/pea/controller: {ros__parameters: {use_sim_time: false, m: 7.0}}", 7.0),
    "octal": ("/pea/controller: {ros__parameters: {m: 010}}", None),
    "hexadecimal": ("/pea/controller: {ros__parameters: {m: 0x10}}", None),
    "by sixties": ("/pea/controller: {ros__parameters: {m: 1:30}}", None),
    "an exponent": ("/pea/controller: {ros__parameters: {m: 7E3}}", 7000.0),
    "of two types": ("/pea/reference: {ros__parameters: {frequencies_hz: [0, 1.5]}}", None),
    "an alias": ("/pea/controller: {ros__parameters: {m: &a 1.0, P: *a}}", None),
}


@pytest.mark.parametrize(("text", "m"), SAME.values(), ids=SAME)
def test_a_file_means_the_same_as_experiment_and_to_a_node(tmp_path, text, m):
    from pea_ros import params
    from pea_ros.context import given as told

    path = tmp_path / "mine.yaml"
    path.write_text(text)

    class Asked:
        get_namespace = staticmethod(lambda: "/pea")
        get_fully_qualified_name = staticmethod(lambda: NODE)

    def to_node() -> Any:
        told.read(["--ros-args", "--params-file", str(path)])
        found = params.overrides(Asked())  # type: ignore[arg-type]
        schema = SCHEMAS["controller"]
        return config.resolve("controller", schema, [{"type": "pidsmc", **found}]).values["m"]

    def as_experiment() -> Any:
        controller = ["controller.type=pidsmc"]
        return experiments.load(str(path), controller).nodes["controller"].values["m"]

    try:
        for read in (to_node, as_experiment):
            if m is None:
                with pytest.raises(ParameterError):
                    read()
            else:
                assert read() == m
    finally:
        told.read([])


@pytest.mark.parametrize("name", ["mine.yaml", "launch_params_mine"])
def test_a_node_says_what_a_file_for_all_says_of_another(tmp_path, name):
    from pea_ros import params
    from pea_ros.context import given as told

    path = tmp_path / name
    path.write_text("/**: {ros__parameters: {m: 7.0, T_s: 0.001, x.zeta: 0.7}}")
    declared = {"m", "T_s", "x.zeta"}

    class Plant:
        get_namespace = staticmethod(lambda: "/stage1")
        get_fully_qualified_name = staticmethod(lambda: "/stage1/plant")
        has_parameter = staticmethod(declared.__contains__)
        undeclare_parameter = staticmethod(declared.remove)

    said: list[str] = []
    told.read(["--ros-args", "--params-file", str(path)])
    try:
        found = params.overrides(Plant())  # type: ignore[arg-type]
        params.leave_out(Plant(), said.append)  # type: ignore[arg-type]
    finally:
        told.read([])
    if name == "mine.yaml":
        assert found == {"T_s": 0.001, "x.zeta": 0.7}
        assert declared == {"T_s", "x.zeta"}
        assert said == [f"{path}: m, for all nodes, is of the controller, not of this one"]
    else:  # of launch, for this node alone: it refuses what it does not have
        assert found == {"m": 7.0, "T_s": 0.001, "x.zeta": 0.7}
        assert not said
        assert declared == {"m", "T_s", "x.zeta"}


def test_a_dump_of_a_plant_in_wall_time_is_a_preset_and_an_experiment(tmp_path):
    values = experiments.load("sine_series").nodes["plant"].values
    path = tmp_path / "dumped.yaml"
    dumped = {**values, "K": 0.14, "clock": "wall", "start_type_description_service": True}
    config.write(path, {"plant": dumped})
    for found in (
        experiments.load("sine_series", [f"plant.preset={path}"]),
        experiments.load(str(path), duration=0.01),
    ):
        assert found.nodes["plant"].values["K"] == 0.14
    config.write(path, {"plant": {"clock": "wall"}})  # somebody asks for it: it is not left out
    with pytest.raises(ParameterError, match=r"plant\.clock"):
        experiments.load(str(path), duration=0.01)


def test_what_is_dumped_is_a_preset_and_an_experiment(tmp_path):
    values = experiments.load("sine_series").nodes["controller"].values
    beside = {"use_sim_time": False, "start_type_description_service": True, "changed_by": "/a"}
    path = tmp_path / "dumped.yaml"
    config.write(path, {"controller": {**values, **beside, "preset": "recommended", "P": 0.0007}})
    found = experiments.load("fig9_hysteresis_10hz", [f"controller.preset={path}"])
    assert found.nodes["controller"].values["P"] == 0.0007
    assert experiments.load(str(path)).nodes["controller"].values["P"] == 0.0007
