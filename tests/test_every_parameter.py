"""Nothing that a user names is silently not in force: every parameter, from every source.

Each type of each node gets a value for each of its parameters that is no default, from one source
after the other, over an experiment that runs another type with values of its own. What the block
of the loop has is read back.
"""

import itertools
from typing import Any

import pytest
import rclpy
from rclpy.node import Node

from pea_cli import cli
from pea_core import config
from pea_core.block import changed
from pea_core.config import NODES, Source, resolve
from pea_core.params import Choice, ParameterError, Spec, build, flatten, layer, specs
from pea_dashboard.tuning import Tuning
from pea_experiment import experiments
from pea_experiment.experiment import SCHEMAS
from pea_plant.model import creep, hysteresis, load
from pea_record.read import load as recording_of
from pea_report import recorded, replay
from pea_ros.context import context, given
from pea_ros.params import BlockParameters, overrides, sources
from pea_ros.shell import Given

TYPES = {
    **{node: [{"type": t} for t in SCHEMAS[node].kinds] for node in NODES[1:]},
    "plant": [
        {f"{group}.type": t}
        for group, kinds in (
            ("hysteresis", hysteresis.CHOICE.kinds),
            ("creep", creep.CHOICE.kinds),
            ("load", load.CHOICE.kinds),
        )
        for t in kinds
    ],
}
CASES = [pytest.param(n, t, id="-".join((n, *t.values()))) for n in NODES for t in TYPES[n]]

FORBIDDEN = {
    ("controller", "eps_compensation"): "predictive rests on its own estimate of eps",
    ("controller", "feedforward"): "predictive rests on it too",
    ("controller", "inverse.thresholds"): "they begin at 0, and there is a weight for each",
    **{
        ("controller", f"inverse.{name}"): "beside eps_compensation it would be counted twice"
        for name in ("weights", "slopes", "alpha")
    },
}
"""Parameters that can have no other value, and why."""

CHOSEN = {
    ("controller", "learning_frequency_hz"): 50.0,
    ("controller", "learning.frequency_hz"): 50.0,
    ("controller", "slew_rate"): 40.0,  # what is injected needs some
    ("reference", "shaper.velocity_max"): 1e11,  # a scan beyond it is refused
    ("reference", "shaper.acceleration_max"): 1e14,
    ("reference", "shaper.jerk_max"): 1e17,
    ("reference", "shaper.slew_rate"): 1e8,
    ("reference", "shaper.current_max"): 500.0,
}
"""Values that must fit others."""

REST = ("experiment.duration=0.001", "plant.sensor.ideal=true")


def another(spec: Spec) -> Any:
    """A value near the default that is another one."""
    default: Any = spec.default
    if spec.choices:
        return next((word for word in spec.choices if word != default), default)
    if spec.kind is bool:
        return not default
    if spec.kind is str:
        return "other"
    if spec.kind is tuple:
        whole = all(x == int(x) for x in default)
        return [x + 1.0 if whole else 0.99 * x for x in default]
    if spec.kind is int:
        return default + 1 if spec.high is None or default < spec.high else default - 1
    tries = (0.99 * default, 1.01 * default, 1e-3, 1e-6, 1e-9)
    low = -1e300 if spec.low is None else spec.low
    high = 1e300 if spec.high is None else spec.high
    return next(x for x in tries if x != default and low <= x <= high)


def whole(node: str, types: dict[str, str], files: dict[str, str]) -> dict[str, Any]:
    """Another value of every parameter that a type has, without those that rules forbid."""
    schema = SCHEMAS[node]
    values: dict[str, Any] = dict(types)
    left = [n for n in specs(schema, types) if n not in values and not n.endswith("type")]
    left = [n for n in left if not n.startswith("driver.")]
    for name in left * 3:  # a rule may ask for one that comes later
        file = files.get(types.get("type", ""), files.get(node))
        value = file if name.endswith("path") else another(specs(schema, types)[name])
        value = CHOSEN.get((node, name), value)
        try:
            build(schema, {**values, name: value})
        except ParameterError:
            continue
        values[name] = value
    assert {(node, name) for name in left if name not in values} <= FORBIDDEN.keys()
    return values


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    there = tmp_path_factory.mktemp("files")
    rows = "".join(f"{k * 1e-4:.4f},{k * 1e-3}\n" for k in range(12))
    for name in ("reference", "plant"):
        (there / f"{name}.csv").write_text(rows)
    (there / "points.csv").write_text("other,dwell\n1,0.1\n2,0.1\n")
    return {name: str(there / f"{name}.csv") for name in ("reference", "plant", "points")}


def base(node: str, types: dict[str, str]) -> dict[str, dict[str, Any]]:
    """Sections of an experiment that runs another type, with values of its own."""
    others = [t for t in TYPES[node] if t != types and t.keys() == types.keys()]
    other = next((t for t in others if "file" not in t.values()), {})
    known = specs(SCHEMAS[node], other)
    own = {n: another(s) for n, s in known.items() if s.kind is float and not s.common}
    if node == "plant":
        own = {n: v for n, v in own.items() if n.startswith(("hysteresis", "creep.", "load."))}
    sections = {
        "experiment": {"duration": 0.001},
        "plant": {"sensor.ideal": True},
        "reference": {"type": "constant", "offset_um": 0.5},
        "observer": {},
        "controller": {},
    }
    sections[node] = {**sections[node], **other, **own}
    return {name: values for name, values in sections.items() if values}


def write(path, sections):
    config.write(path, sections)
    return str(path)


def texts(node, values):
    return [f"{node}.{name}={_text(value)}" for name, value in values.items()]


def _text(value):
    value = list(value) if isinstance(value, tuple) else value
    return str(value).lower() if isinstance(value, bool) else str(value)


def in_force(experiment, node):
    """What the block of a new loop has."""
    block = getattr(experiment.loop(), node)
    return flatten(SCHEMAS[node], block.params)


def the_same(found, values):
    asked, there = ({n: plain(v) for n, v in each.items()} for each in (values, found))
    assert {name: there[name] for name in asked} == asked


def plain(value):
    """A list of any kind as a tuple."""
    return tuple(value) if hasattr(value, "__len__") and not isinstance(value, str) else value


@pytest.mark.parametrize("source", ["command line", "experiment", "preset", "rig"])
@pytest.mark.parametrize(("node", "types"), CASES)
def test_a_source_is_in_force(node, types, source, files, tmp_path):
    values = whole(node, types, files)
    sections = base(node, types)
    sets, rig = [], None
    if source == "experiment":
        sections[node] = values | ({"sensor.ideal": True} if node == "plant" else {})
    elif source == "command line":
        sets = texts(node, values)
    elif source == "preset":
        preset = write(tmp_path / "mine.yaml", {node: values})
        sets = [f"{node}.preset={preset}"]
    else:
        rig = write(tmp_path / "stage.yaml", {node: values})
    file = write(tmp_path / "one.yaml", sections)
    if node == "plant":
        values = {n: v for n, v in values.items() if n != "sensor.ideal"}
        if source != "experiment":
            sets.append("plant.sensor.ideal=true")
    experiment = experiments.load(file, sets, rig=rig)
    the_same(in_force(experiment, node), values)
    the_same(experiment.sections()[node], values)
    again = write(tmp_path / "params.yaml", experiment.sections())
    assert experiments.load(again).sections() == experiment.sections() | {
        "experiment": experiments.load(again).sections()["experiment"]
    }


@pytest.mark.parametrize("source", ["command line", "experiment"])
@pytest.mark.parametrize(("node", "types"), CASES)
def test_what_is_said_of_one_axis_is_in_force_there_alone(node, types, source, files, tmp_path):
    values = {n: v for n, v in whole(node, types, files).items() if not config.shared(n)}
    sections = base(node, types)
    axes = "axes=[x, y]"
    plain_file = write(tmp_path / "one.yaml", sections)
    before = flatten(SCHEMAS[node], experiments.load(plain_file).nodes[node].params)
    own = {f"y.{name}": value for name, value in values.items()}
    if source == "experiment":
        sections[node] = sections.get(node, {}) | own
        found = experiments.load_axes(write(tmp_path / "two.yaml", sections), [axes])
    else:
        found = experiments.load_axes(plain_file, [axes, *texts(node, own)])
    x, y = (flatten(SCHEMAS[node], one.nodes[node].params) for one in found.each)
    the_same(x, before)
    the_same(y, values)
    again = experiments.load_axes(write(tmp_path / "params.yaml", found.sections()))
    assert [one.nodes[node].params for one in again.each] == [
        one.nodes[node].params for one in found.each
    ]


@pytest.mark.parametrize(("node", "types"), CASES)
def test_a_live_change_is_in_force_and_nothing_is_inherited(node, types, files):
    schema = SCHEMAS[node]
    for start in TYPES[node]:
        if node in ("plant", "reference") and start != types:
            continue  # their types are fixed while the loop runs
        if start.keys() != types.keys() or "file" in start.values():
            continue
        at_first = build(schema, {**start, **_required(start, files)})
        live = {
            name: value
            for name, value in whole(node, types, files).items()
            if name in types or not specs(schema, types)[name].fixed
        }
        found = flatten(schema, changed(schema, at_first, live))
        the_same(found, live)
        alone = flatten(schema, changed(schema, at_first, dict(types)))
        defaults = flatten(schema, build(schema, {**types, **_required(types, files)}))
        the_same(alone, defaults)


def _required(types, files):
    return {"load.path": files["plant"]} if types.get("load.type") == "file" else {}


@pytest.mark.parametrize(("node", "types"), [c for c in CASES if c.values[0] in NODES[1:3]])
def test_a_type_keeps_no_gain_of_the_type_before(node, types):
    schema: Choice = SCHEMAS[node]  # type: ignore[assignment]
    default = flatten(schema, schema.kinds[types["type"]]())
    for other in TYPES[node]:
        if other == types:
            continue
        known = specs(schema, other)
        before = {n: another(s) for n, s in known.items() if s.kind is float}
        now = flatten(schema, changed(schema, build(schema, {**other, **before}), types))
        common = {n for n in now if n in known and known[n].common}
        the_same(now, {n: v for n, v in default.items() if n not in common})
        the_same(now, {n: before[n] for n in common & before.keys()})


@pytest.mark.parametrize(("node", "types"), [c for c in CASES if c.values[0] in NODES[1:3]])
def test_what_the_dashboard_asks_for_is_in_force(node, types, files, tmp_path):
    file = write(tmp_path / "one.yaml", base(node, types))
    running = experiments.load(file)
    tuning = Tuning()
    tuning.rest_on({n: r.values for n, r in running.nodes.items()}, live=False)
    values = whole(node, types, files)
    tuning.think(node, {n: tuple(v) if isinstance(v, list) else v for n, v in values.items()})
    tuning.rest_on({n: r.values for n, r in running.nodes.items()}, live=False)
    other = next(t["type"] for t in TYPES[node] if t != types)
    sets = tuning.over({f"{node}.preset": "nothing", f"{node}.type": other})
    started = experiments.load(file, [f"{n}={_text(v)}" for n, v in sets.items()])
    the_same(in_force(started, node), values)


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    there = tmp_path_factory.mktemp("bag") / "run"
    sets = [word for each in REST for word in ("--set", each)]
    assert cli.main(["run", "sine_series", *sets, "--out", str(there)]) == 0
    return there


@pytest.mark.parametrize(("node", "types"), [c for c in CASES if c.values[0] in NODES[1:3]])
def test_what_a_replay_is_asked_for_is_in_force(node, types, files, bag, tmp_path):
    values = whole(node, types, files)
    recording = recording_of(bag)
    found = recorded.experiment_of(recording, bag, texts(node, values))
    the_same(in_force(found, node), values)
    preset = write(tmp_path / "mine.yaml", {node: values})
    found = recorded.experiment_of(recording, bag, [f"{node}.preset={preset}"])
    the_same(in_force(found, node), values)
    decided = replay.asked([f"{node}.preset={preset}"], {}, "both")[node]
    assert values.keys() <= decided | {"type"}


@pytest.fixture(scope="module")
def graph(tmp_path_factory):
    patch = pytest.MonkeyPatch()
    patch.setenv("ROS_LOG_DIR", str(tmp_path_factory.mktemp("log")))
    patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    with context():
        yield
    patch.undo()


def served(node, given_by):
    """A ROS node with the parameters of a block, as every mode has it."""
    made = Node(
        f"{node}_{next(NUMBER)}",
        allow_undeclared_parameters=True,
        use_global_arguments=False,
        automatically_declare_parameters_from_overrides=True,
    )
    return made, BlockParameters(made, node, SCHEMAS[node], given_by)


NUMBER = itertools.count()


def ros_values(made, names):
    return {name: made.get_parameter(name).value for name in names}


@pytest.mark.parametrize(("node", "types"), CASES)
def test_a_node_has_what_it_is_given_and_what_it_is_asked_for_live(graph, node, types, files):
    from rclpy.parameter import Parameter

    values = whole(node, types, files)
    made, parameters = served(node, [Source(base(node, types).get(node, {})), Source(values)])
    the_same(parameters.values, values)
    the_same(ros_values(made, values), values)
    made.destroy_node()
    fixed = {n for n, s in specs(SCHEMAS[node], types).items() if s.fixed}
    start = {n: v for n, v in values.items() if n in fixed}
    if node in NODES[1:3]:
        start = {"type": next(t["type"] for t in TYPES[node] if t != types)}
    made, parameters = served(node, [Source(start)])
    live = {n: v for n, v in values.items() if n not in fixed}
    asked = [Parameter(n, value=list(v) if isinstance(v, tuple) else v) for n, v in live.items()]
    answer = made.set_parameters_atomically(asked)
    assert answer.successful, answer.reason
    the_same(parameters.values, live)
    the_same(ros_values(made, parameters.values), parameters.values)
    made.destroy_node()


@pytest.mark.parametrize("section", ["/**", "/stage1/{}"])
@pytest.mark.parametrize(("node", "types"), CASES)
def test_a_parameter_file_is_in_force_in_the_node_it_names(
    graph, node, types, section, files, tmp_path
):
    """Over a file that says other values of the same node; read by rclpy, too."""
    values = whole(node, types, files)
    weak = tmp_path / "weak.yaml"
    config.write(weak, {node: base(node, types).get(node) or {"T_s": 50e-6}}, "/**")
    text = config.dump({node: values}, "").replace(f"/{node}:", f"{section.format(node)}:", 1)
    strong = tmp_path / "strong.yaml"
    strong.write_text(text, encoding="utf-8")
    arguments = ["--ros-args", "--params-file", str(weak), "--params-file", str(strong)]
    arguments += ["-r", "__ns:=/stage1"]
    apart = rclpy.Context()
    rclpy.init(args=arguments, context=apart)
    try:
        made = Given(
            node,
            namespace=config.NAMESPACE,
            context=apart,
            enable_rosout=False,
            start_parameter_services=False,
            allow_undeclared_parameters=True,
            automatically_declare_parameters_from_overrides=True,
        )
        given.read(arguments)
        found = sources(made.get_fully_qualified_name(), overrides(made))
        parameters = BlockParameters(made, node, SCHEMAS[node], found)
        the_same(flatten(SCHEMAS[node], parameters.params), values)
        the_same(ros_values(made, values), values)
        made.destroy_node()
    finally:
        given.read([])
        apart.try_shutdown()


def test_another_type_is_told_whole_and_forgets_the_preset(graph):
    from rclpy.parameter import Parameter

    made, parameters = served("observer", [Source({"type": "discrete_uio_two_step", "K": 0.15})])
    told = []
    made.add_post_set_parameters_callback(lambda each: told.append({p.name: p.value for p in each}))
    assert made.set_parameters_atomically([Parameter("type", value="extended_state")]).successful
    assert parameters.values["omega_o"] == made.get_parameter("omega_o").value == 20000.0
    assert parameters.values["K"] == 0.15
    assert told[0] == {"type": "extended_state", "omega_o": 20000.0}
    made.destroy_node()
    made, parameters = served("observer", [Source({"preset": "kalman"})])
    assert made.get_parameter("preset").value == "kalman"
    assert made.set_parameters_atomically([Parameter("type", value="levant")]).successful
    assert made.get_parameter("preset").value == parameters.all["preset"] == ""
    made.destroy_node()


def test_another_type_comes_with_its_own_preset_live_and_all_of_it_is_told(graph):
    """A recorded change makes the same block again, from the values that it tells alone."""
    from rclpy.parameter import Parameter

    at_first = {"type": "pidsmc", "preview_samples": 0.5, "voltage_max": 100.0}
    made, parameters = served("controller", [Source(at_first)])
    schema, told = SCHEMAS["controller"], []
    before = parameters.params
    made.add_post_set_parameters_callback(lambda each: told.append({p.name: p.value for p in each}))
    asked = [Parameter("type", value="pid"), Parameter("K_i", value=3.0)]
    assert made.set_parameters_atomically(asked).successful
    found = {n: parameters.values[n] for n in ("K_p", "K_i", "preview_samples", "voltage_max")}
    assert found == {"K_p": 8.5, "K_i": 3.0, "preview_samples": 0.5, "voltage_max": 100.0}
    new = {n: made.get_parameter(n).value for n in ("K_p", "K_d", "T_f")}  # declared: new, so told
    assert changed(schema, before, {**told[0], **new}) == parameters.params
    made.destroy_node()


def test_resolved_values_say_what_a_block_has():
    for node, schema in SCHEMAS.items():
        found = resolve(node, schema, [{}])
        assert build(schema, layer(schema, {}, config.split(found.values)[1])) == found.params
