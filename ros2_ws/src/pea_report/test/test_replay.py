"""Blocks run again on a recording: the same bits, or the first that is not."""

import json

import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from pea_cli import cli
from pea_core.block import changed
from pea_core.params import ParameterError
from pea_core.signals import SAMPLE
from pea_experiment import experiments
from pea_experiment.experiment import SCHEMAS
from pea_record.bag import BagWriter
from pea_record.origin import ORIGIN, origin
from pea_record.read import load
from pea_record.recording import BagError
from pea_record.rows import ahead, record
from pea_report.recorded import Untold, axes_experiment_of, experiment_of, sections
from pea_report.replay import SIGNALS, asked, divergence, replay
from pea_wire import events
from pea_wire.topics import PARAMETER_EVENTS, STATE, VOLTAGE

T_NS = 50_000
N = 300
CHANGES = {
    100: ("controller", {"P": 0.0123456789, "I": 3.3}),
    170: ("observer", {"noise_nm": 1.1}),
    220: ("controller", {"P": 0.004}),
}
KALMAN = {"observer": "kalman"}
SETS = (
    "controller.preview_samples=1.5",
    "controller.eps_compensation=true",
    "plant.sensor.noise_nm=2.0",
    "plant.sensor.ideal=false",
)


def experiment(*sets):
    return experiments.load("fig9_hysteresis_10hz", (*SETS, *sets), N * T_NS * 1e-9, None, KALMAN)


def write(
    directory,
    what,
    changes=CHANGES,
    told=True,
    edit=lambda rows: rows,
    after=True,
    compiled=False,
):
    """Record a run whose parameters change, as composed mode does."""
    loop = what.loop(compiled)
    with BagWriter(directory, T_NS) as bag:
        if told:
            bag.metadata(ORIGIN, origin(what.name, what.sections(), "batch", T_NS))
        for k in range(0, N, 10):
            if k in changes:
                node, values = changes[k]
                block = getattr(loop, node)
                block.retune(changed(SCHEMAS[node], block.planned, values))
                event = events.encode(k * T_NS, f"/pea/{node}", values)
                bag.write(PARAMETER_EVENTS, k * T_NS, event)
            rows = edit(loop.run(10))
            ends = after and loop.k == N
            record(bag, k, T_NS, rows, *([ahead(loop)] if ends else []))
    return directory


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write(tmp_path_factory.mktemp("run") / "bag", experiment())


def again(bag, through="both", sets=(), others=None, **more):
    recording = load(bag)
    what = experiment_of(recording, bag, sets, others, **more)
    return replay(recording, what, bag, through, asked(sets, others or {}, through))


@pytest.mark.parametrize(("through", "changes"), [("observer", 1), ("controller", 2), ("both", 3)])
def test_run_with_changes_of_parameters_is_repeated_to_the_bit(bag, through, changes):
    found = again(bag, through)

    assert (len(found.samples), found.changes, found.first) == (N, changes, None)
    assert found.samples.tobytes() == found.recorded.tobytes()


@pytest.mark.parametrize("left_out", [100, 170, 220])
def test_replay_without_a_change_differs_from_there_on(tmp_path, left_out):
    directory = write(tmp_path / "bag", experiment())
    recording = load(directory)
    recording.events[:] = [e for e in recording.events if e.stamp != left_out * T_NS]

    found = replay(recording, experiment_of(recording, directory), directory)

    # the first sample that goes by a change is that of the run without it, to rounding
    assert left_out <= found.first.sample <= left_out + 1


@pytest.mark.parametrize(
    ("field", "topic", "name"),
    [("u", VOLTAGE.name, "effort"), ("eps_hat", STATE.name, "effort"),
     ("x1_hat", STATE.name, "position"), ("x2_hat", STATE.name, "velocity")],
)  # fmt: skip
def test_one_bit_is_found_and_named(tmp_path, field, topic, name):
    at = iter(range(0, N, 10))

    def flip(rows):
        if next(at) == 150:
            rows[field].view("<u8")[3] ^= 1
        return rows

    found = again(write(tmp_path / "bag", experiment(), edit=flip))

    assert (found.first.sample, found.first.topic, found.first.field) == (153, topic, name)
    assert found.first.first != found.first.second


def test_bits_are_compared_and_not_numbers():
    first = np.zeros(4, SAMPLE)
    first["y_dot"] = np.nan
    second = first.copy()
    assert divergence(first, second, SIGNALS) is None

    second["u"][2] = -0.0
    assert divergence(first, second, SIGNALS) == (2, VOLTAGE.name, "effort", 0.0, -0.0)


def test_replay_ends_where_the_preview_ends(tmp_path):
    found = again(write(tmp_path / "bag", experiment(), after=False))

    assert (len(found.samples), found.first) == (N - 2, None)


def test_other_parameters_tell_what_they_would_have_said(bag):
    found = again(bag, "controller", ["controller.m=4000"])

    assert found.first.topic == VOLTAGE.name
    for name in ("x1_hat", "x2_hat", "eps_hat"):
        assert found.samples[name].tobytes() == found.recorded[name].tobytes()
    expected = float(np.sqrt(np.mean((found.samples["u"] - found.recorded["u"]) ** 2)))
    assert found.differences["u"]["rms"] == pytest.approx(expected, rel=1e-12)


def test_parameter_that_is_set_does_not_change_again(bag):
    found = again(bag, "controller", ["controller.P=0.004"])

    assert found.changes == 1  # of I, at 100


def test_another_observer_is_told_what_the_first_was(bag):
    found = again(bag, "observer", others={"observer": "luenberger"})

    assert found.changes == 0
    assert found.differences["x1_hat"]["max"] > 0.0
    assert found.samples["u"].tobytes() == found.recorded["u"].tobytes()


@pytest.mark.parametrize(
    ("sets", "others", "through", "why"),
    [
        (["plant.seed=2"], {}, "both", "plant.seed: replay --through both runs observer and"),
        (["observer.noise_nm=2"], {}, "controller", "runs controller only"),
        (["T_s=1e-4"], {}, "both", "the recording has its own sample period"),
        ([], {"controller": "pid"}, "observer", "--controller: replay --through observer runs"),
    ],
)
def test_what_does_not_run_again_cannot_be_changed(sets, others, through, why):
    with pytest.raises(ParameterError, match=why):
        asked(sets, others, through)


def test_bag_that_does_not_say_what_ran_is_refused(tmp_path):
    directory = write(tmp_path / "bag", experiment(), told=False)

    with pytest.raises(BagError, match=r"does not say what ran.*give --params FILE"):
        experiment_of(load(directory), directory)


def test_bag_that_does_not_say_what_one_node_ran_is_refused(bag):
    recording = load(bag)
    told = yaml.safe_load(recording.metadata[ORIGIN]["parameters"])
    del told["/pea/controller"]
    recording.metadata[ORIGIN]["parameters"] = yaml.safe_dump(told)

    with pytest.raises(Untold, match=r"does not say what /pea/controller ran.*give --params FILE"):
        experiment_of(recording, bag)


def untold(bag, *nodes):
    """A recording of which some nodes were not ours: nobody told what they ran."""
    recording = load(bag)
    told = yaml.safe_load(recording.metadata[ORIGIN]["parameters"])
    for node in nodes:
        del told[f"/pea/{node}"]
    recording.metadata[ORIGIN]["parameters"] = yaml.safe_dump(told)
    return recording


@pytest.mark.parametrize(
    ("through", "others"),
    [
        ("both", ["reference"]),
        ("both", ["plant", "reference"]),
        ("observer", ["plant", "controller", "reference"]),
        ("controller", ["observer"]),
    ],
)
def test_blocks_between_nodes_that_are_not_ours_run_again(bag, through, others):
    recording = untold(bag, *others)
    what = axes_experiment_of(recording, bag, through=through)
    found = replay(recording, what, bag, through)
    assert (len(found.samples), found.first) == (N, None)
    with pytest.raises(Untold, match=f"does not say what /pea/{others[0]}"):
        axes_experiment_of(recording, bag)


def test_a_block_that_is_not_ours_does_not_run_again(bag):
    recording = untold(bag, "observer", "reference")
    with pytest.raises(Untold, match=r"does not say what /pea/observer ran.*give --params FILE"):
        axes_experiment_of(recording, bag, through="both")


def test_parameters_beside_a_bag_or_named_are_taken(tmp_path, bag):
    directory = write(tmp_path / "bag", experiment(), told=False)
    text = load(bag).metadata[ORIGIN]["parameters"]
    (tmp_path / "mine.yaml").write_text(text)

    assert again(directory, params=tmp_path / "mine.yaml").first is None
    (directory / "params.yaml").write_text(text)
    assert again(directory).first is None


def test_bag_of_another_recorder_replays(tmp_path, bag):
    arrival = 1_700_000_000 * 10**9
    other = tmp_path / "other"
    with (
        AnyReader([bag]) as reader,
        Writer(other, version=9, storage_plugin=StoragePlugin.MCAP) as writer,
    ):
        store = get_typestore(Stores.ROS2_JAZZY)
        links = {
            c.topic: writer.add_connection(c.topic, c.msgtype, typestore=store)
            for c in reader.connections
        }
        for i, (connection, _, data) in enumerate(reader.messages()):
            writer.write(links[connection.topic], arrival + i, data)
    (other / "params.yaml").write_text(load(bag).metadata[ORIGIN]["parameters"])

    found = again(other)

    assert (len(found.samples), found.changes, found.first) == (N, 3, None)


def test_other_format_and_other_T_s_are_refused(tmp_path, bag):
    recording = load(bag)
    recording.metadata[ORIGIN]["format"] = "99"
    with pytest.raises(BagError, match="is of format '99': this version knows 1"):
        experiment_of(recording, bag)

    other = load(bag)
    text = other.metadata[ORIGIN]["parameters"]
    other.metadata[ORIGIN]["parameters"] = text.replace("T_s: 5.0e-05", "T_s: 1.0e-04")
    with pytest.raises(BagError, match="every 50000 ns, and its parameters say T_s = 100000"):
        experiment_of(other, bag)


def test_bag_that_begins_later_is_refused(tmp_path, bag):
    recording = load(bag)
    recording.stamps[:] += T_NS

    with pytest.raises(BagError, match="begins at 50000 ns: what the blocks knew"):
        replay(recording, experiment_of(recording, bag), bag)


def test_change_that_does_not_fit_is_refused(tmp_path, bag):
    recording = load(bag)
    recording.events[0].changed["P"] = "much"

    with pytest.raises(BagError, match="change of /pea/controller at 5000000 ns: P"):
        replay(recording, experiment_of(recording, bag), bag)


def test_parameters_in_force_follow_the_changes(bag):
    recording = load(bag)
    what = experiment_of(recording, bag)

    def P(k):
        return sections(recording, what, k * T_NS)["controller"]["P"]

    start = what.nodes["controller"].values["P"]
    assert (P(99), P(100), P(219), P(220)) == (start, 0.0123456789, 0.0123456789, 0.004)


def test_bag_of_an_interrupted_run_replays_up_to_a_gap(tmp_path):
    directory = tmp_path / "bag"
    whole = load(write(tmp_path / "whole", experiment(), changes={}))
    with BagWriter(directory, T_NS) as bag:
        for name, values in whole.metadata.items():
            if name == ORIGIN:
                bag.metadata(name, values)
        record(bag, 0, T_NS, whole.samples[:100])
        record(bag, 120, T_NS, whole.samples[120:])

    found = again(directory, "observer")

    assert (len(found.samples), found.first) == (100, None)


def status(capsys, *arguments):
    code = cli.main(list(map(str, arguments)))
    return code, capsys.readouterr()


def test_command_says_the_same_or_where_not(tmp_path, bag, capsys):
    assert status(capsys, "replay", bag)[0] == 0

    def flip(rows):
        rows["u"][0] += 1.0
        return rows

    broken = write(tmp_path / "bag", experiment(), edit=flip)
    code, said = status(capsys, "replay", broken, "--json")
    assert code == 3
    told = json.loads(said.out)
    assert (told["exact"], told["first"]["sample"], told["first"]["topic"]) == (
        False,
        0,
        VOLTAGE.name,
    )


def test_command_draws_what_would_have_been_said(tmp_path, bag, capsys):
    plot = tmp_path / "what.png"
    more = ("--set", "controller.P=0.01", "--out", plot, "--json")
    code, said = status(capsys, "replay", bag, *more)

    assert code == 0
    assert json.loads(said.out)["differences"]["u"]["rms"] > 0.0
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert status(capsys, "replay", bag, "--out", plot)[0] == 2


def test_a_change_of_a_reference_that_was_looked_at_ahead_replays(tmp_path):
    """Compiled, with a change of the law under way when the second one comes."""
    what = experiment()
    changes = {
        100: ("reference", {"amplitude_um": 3.0}),
        200: ("controller", {"P": 0.004}),
        210: ("reference", {"amplitude_um": 4.0}),
    }
    recording = load(write(tmp_path / "bag", what, changes, compiled=True))

    w = recording.samples["w"]
    assert np.count_nonzero(np.abs(np.diff(w)) > 1e-7) == 2
    assert replay(recording, what, tmp_path / "bag").first is None


def test_golden_is_made_anew_by_its_own_command_only(tmp_path, bag, capsys):
    (mcap,) = bag.glob("*.mcap")
    golden = tmp_path / "golden.mcap"
    golden.write_bytes(mcap.read_bytes())

    assert status(capsys, "replay", golden, "--update-golden")[0] == 0
    assert golden.read_bytes() != mcap.read_bytes()
    assert status(capsys, "replay", golden)[0] == 0
    assert status(capsys, "replay", bag, "--update-golden")[0] == 2
