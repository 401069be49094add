"""Recordings of several axes: replayed, read as tables, cut, compared and shown."""

import json

import h5py
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.io import loadmat

import pea
from pea_cli import cli
from pea_core.block import changed
from pea_core.loop import blocks_of
from pea_core.signals import SAMPLE
from pea_experiment import experiments
from pea_experiment.experiment import SCHEMAS
from pea_record.bag import BagWriter
from pea_record.origin import ORIGIN, origin
from pea_record.read import load, load_axes
from pea_record.recording import BagError
from pea_record.rows import NOTHING, ahead, record
from pea_report import figures, recorded, replay, report
from pea_wire import events
from pea_wire.topics import DISPLACEMENT, PARAMETER_EVENTS, VOLTAGE

N, T_NS = 300, 50_000
CHANGED = 150
SETS = (
    "axes=[x, y]",
    "plant.stage.cross_talk=[0.0, 0.05, 0.1, 0.0]",
    "plant.sensor.noise_nm=2.0",
    "plant.sensor.ideal=false",
    "plant.y.K=0.12",
    "plant.y.seed=2",
    "controller.y.preview_samples=1.5",
    "observer.y.type=extended_state",
)


def experiment(*sets):
    return experiments.load_axes(
        "fig9_hysteresis_10hz", (*SETS, *sets), N * T_NS * 1e-9, None, {"observer": "kalman"}
    )


def write(directory, what):
    """Record a run in which P of y changes, as composed mode does."""
    loop = what.loop()
    block = loop.controller.blocks[1]
    with BagWriter(directory, T_NS) as bag:
        bag.metadata(ORIGIN, origin(what.name, what.sections(), "batch", T_NS))
        for samples in blocks_of(N, 50):
            k = loop.k
            if k == CHANGED:
                values = {"P": 0.0123456789}
                block.retune(changed(SCHEMAS["controller"], block.planned, values))
                told = {f"y.{name}": value for name, value in values.items()}
                event = events.encode(k * T_NS, "/pea/controller", told)
                bag.write(PARAMETER_EVENTS, k * T_NS, event)
            rows = loop.run(samples)
            record(bag, k, T_NS, rows, ahead(loop) if loop.k == N else NOTHING, what.axes)
    return directory


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write(tmp_path_factory.mktemp("run") / "bag", experiment())


def again(path, *sets, **others):
    recording = load_axes(path)
    what = recorded.axes_experiment_of(recording, path, sets, others)
    without = {a: replay.asked(sets, others, "both", recording.axes, a) for a in recording.axes}
    return replay.replay_axes(recording, what, path, "both", without)


def test_axes_are_replayed_to_the_bit_with_the_change_of_one(bag):
    found = again(bag)

    assert [(axis, one.first, one.changes) for axis, one in found.items()] == [
        ("x", None, 0),
        ("y", None, 1),
    ]


@pytest.mark.parametrize("axis", ["x", "y"])
def test_one_axis_is_replayed_alone(bag, axis):
    found = again(bag.with_name(f"bag@{axis}"))

    assert [(name, one.first) for name, one in found.items()] == [(axis, None)]


def test_a_law_is_exchanged_on_one_axis(bag):
    found = again(bag, "controller.y.type=smc")

    assert found["x"].first is None
    assert found["y"].first.sample == 0
    assert found["y"].changes == 0  # another law begins with its own values


def test_an_observer_is_exchanged_on_all_axes(bag):
    found = again(bag, observer="levant")

    assert all(one.first is not None for one in found.values())


def test_a_change_does_not_count_beside_the_value_of_that_axis_alone(bag):
    assert again(bag, "controller.x.P=0.002")["y"].changes == 1
    assert again(bag, "controller.y.P=0.002")["y"].changes == 0
    assert again(bag, "controller.P=0.002")["y"].changes == 0


def test_one_bit_is_found_and_its_axis_named(bag, tmp_path, capsys):
    recording = load_axes(bag)
    recording.samples["u"][77, 1] += 1e-12
    found = replay.replay_axes(recording, recorded.axes_experiment_of(recording, bag), bag)

    assert replay.first_of(found)[0] == "y"
    assert replay.first_of(found)[1].sample == 77


@pytest.mark.parametrize("command", [("replay",), ("bag", "check"), ("bag", "info")])
@pytest.mark.parametrize("axis", ["", "@y"])
def test_commands_take_all_axes_or_one(bag, capsys, command, axis):
    assert cli.main([*command, f"{bag}{axis}", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["samples"] == N


@pytest.mark.parametrize("command", [("replay",), ("bag", "check"), ("export", "--csv", "no.csv")])
def test_an_axis_that_is_not_there_is_named(bag, capsys, command):
    assert cli.main([command[0], *command[1:], f"{bag}@z"]) == 2
    assert "no axis 'z': the axes are x, y" in capsys.readouterr().err


def test_parts_are_of_all_axes(bag, tmp_path, capsys):
    cut = tmp_path / "cut"
    assert cli.main(["bag", "cut", str(bag), "--from", "0.005", "--out", str(cut)]) == 0
    part = load_axes(cut)
    assert part.axes == ("x", "y")
    assert part.samples.tobytes() == load_axes(bag).samples[100:].tobytes()
    assert cli.main(["bag", "cut", f"{bag}@x", "--from", "0.005", "--out", str(cut)]) == 2
    assert "all axes" in capsys.readouterr().err


def test_the_first_difference_of_two_runs_names_its_axis(bag, tmp_path, capsys):
    other = write(tmp_path / "other", experiment("controller.y.I=3.0"))
    assert cli.main(["diff", str(bag), str(other), "--json"]) == 3
    told = json.loads(capsys.readouterr().out)
    assert list(told["parameters"]) == ["controller.y.I"]
    assert told["first"]["axis"] == "y"
    assert {name.partition(".")[0] for name in told["metrics"]} >= {"y"}


def test_a_table_has_the_columns_of_each_axis(bag):
    run, samples = pea.load(bag), load_axes(bag).samples

    assert run.columns[:2] == ("t", "x.w")
    assert run.units["y.u"] == "V"
    for i, axis in enumerate(run.axes):
        for name in ("y", "u"):
            assert np.array_equal(run[f"{axis}.{name}"], samples[name][:, i])
    assert list(run.to_pandas("x.y", "y.y").columns) == ["x.y", "y.y"]
    assert run.to_xarray()["y.u"].attrs["units"] == "V"
    alone = pea.load(f"{bag}@y")
    assert np.array_equal(alone["y"], run["y.y"])


def test_a_part_of_a_table_has_them_too(bag):
    part, alone = (pea.load(f"{bag}{end}", start=0.005, end=0.01) for end in ("", "@y"))

    assert np.array_equal(part["y.u"], pea.load(bag)["y.u"][100:200])
    assert np.array_equal(alone["u"], part["y.u"])
    assert np.array_equal(part.to_xarray()["x.y"].values, part["x.y"])


def test_true_states_are_those_of_the_plant_of_all_axes(bag):
    loop = experiment().loop()
    run = pea.load(bag, truth=True)

    assert np.array_equal(pea.load(f"{bag}@y", truth=True)["x1"], run["y.x1"])
    loop.run(CHANGED)  # until the change
    at = loop.plant.truth  # before the next sample
    assert [run[f"{axis}.x1"][CHANGED] for axis in run.axes] == [one.x1 for one in at]


def test_exports_hold_every_axis(bag, tmp_path):
    run = pea.load(bag)
    run.to_csv(tmp_path / "a.csv")
    run.to_hdf5(tmp_path / "a.h5")
    run.to_mat(tmp_path / "a.mat")
    run.to_netcdf(tmp_path / "a.nc")

    head = (tmp_path / "a.csv").read_text().splitlines()[0].split(",")
    assert "y.u [V]" in head
    table = np.loadtxt(tmp_path / "a.csv", delimiter=",", skiprows=1)
    assert np.array_equal(table[:, head.index("y.u [V]")], run["y.u"])
    with h5py.File(tmp_path / "a.h5") as file:
        assert np.array_equal(file["y.u"][:], run["y.u"])
    assert np.array_equal(loadmat(tmp_path / "a.mat")["y"]["u"][0, 0][:, 0], run["y.u"])


def test_others_read_every_axis(bag):
    store = get_typestore(Stores.ROS2_JAZZY)
    recording = load_axes(bag)
    seen = {DISPLACEMENT.name: [], VOLTAGE.name: []}
    with AnyReader([bag], default_typestore=store) as reader:
        for connection, _, data in reader.messages():
            if connection.topic in seen:
                seen[connection.topic].append(reader.deserialize(data, connection.msgtype))
    for topic, messages in seen.items():
        assert {tuple(message.name) for message in messages} == {("x", "y")}, topic
    y = np.array([message.position for message in seen[DISPLACEMENT.name]])
    u = np.array([message.effort for message in seen[VOLTAGE.name]])
    assert np.array_equal(y, recording.samples["y"])
    assert np.array_equal(u, recording.samples["u"])


def test_what_takes_one_axis_says_so(bag):
    with pytest.raises(BagError, match=r"has the axes x, y, and this takes one: write .*bag@x"):
        load(bag)


def test_a_report_shows_each_axis_and_their_path(bag, tmp_path):
    entries = report.entries(bag, "run")

    assert [entry.run.name for entry in entries] == ["run@x", "run@y"]
    assert [len(entry.recording.events) for entry in entries] == [0, 1]
    text = report.page_text("run", entries, "")
    assert "path of x and y" in text
    assert entries[1].run.true is not None


def test_no_legend_lies_over_data():
    samples, about = np.zeros(50, SAMPLE), {"segments": [], "rms_error_nm": 0.0}
    run = figures.Run("a", np.arange(50.0), samples, None, (), about)
    plot = figures.figure("t", [run, run], (figures.tracking, figures.voltage))
    plot.canvas.draw()
    for axis in plot.axes:
        box = axis.get_legend().get_window_extent()
        assert box.y0 >= axis.get_window_extent().y1 - 1.0
        assert box.y1 <= axis.title.get_window_extent().y0 + 1.0
        assert "um" not in axis.get_ylabel()
