"""A recording as a table, and written for others."""

import csv
import json
import shutil

import numpy as np
import pytest
from pyarrow import parquet
from scipy.io import loadmat

import pea
from pea_cli import cli
from pea_core.signals import SAMPLE
from pea_experiment import experiments
from pea_record.frame import UNITS
from pea_record.recording import BagError
from pea_run.modes import batch

N = 120
SETS = ("plant.sensor.ideal=false", "plant.sensor.noise_nm=0.5")


def made(directory, *sets):
    what = experiments.load(
        "fig9_hysteresis_10hz", (*SETS, *sets), N * 50e-6, None, {"observer": "extended_state"}
    )
    batch.run(what, directory, lambda k: None)
    return directory


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return made(tmp_path_factory.mktemp("run") / "bag")


@pytest.fixture(scope="module")
def frame(bag):
    return pea.load(bag)


def test_columns_are_time_and_the_samples(frame):
    assert tuple(frame) == frame.columns == ("t", *SAMPLE.names)
    assert (len(frame), frame.T_s) == (N, 50e-6)
    assert np.array_equal(frame["t"], np.arange(N) * 50_000 * 1e-9)
    for name in SAMPLE.names:
        assert frame[name].tobytes() == frame.samples[name].tobytes()


def test_every_column_has_a_unit(frame):
    assert frame.units.keys() == set(frame)
    assert (frame.units["y"], frame.units["u"], frame.units["t"]) == ("m", "V", "s")


def test_unknown_column_is_named(frame):
    with pytest.raises(KeyError, match="'z': one of t, w"):
        frame["z"]


def test_parameters_and_run_are_told(frame):
    assert frame.parameters["plant"]["sensor"]["noise_nm"] == 0.5
    assert frame.parameters["observer"]["type"] == "extended_state"
    assert frame.metadata["experiment"] == "fig9_hysteresis_10hz"
    assert (frame.metadata["mode"], frame.metadata["sample_period_ns"]) == ("batch", "50000")


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_a_table_that_was_not_finished_leaves_no_file(tmp_path, bag, monkeypatch, kind):
    frame = pea.load(bag)
    whole = list(frame.pieces())

    def pieces():
        yield from whole
        raise KeyboardInterrupt

    monkeypatch.setattr(frame, "pieces", pieces)
    with pytest.raises(KeyboardInterrupt):
        getattr(frame, f"to_{kind}")(tmp_path / "table")
    assert list(tmp_path.iterdir()) == []


def test_csv_gives_every_bit_back(tmp_path, frame):
    frame.to_csv(tmp_path / "a.csv")

    with open(tmp_path / "a.csv", newline="") as file:
        head, *rows = csv.reader(file)
    assert head == [f"{name} [{unit}]" for name, unit in UNITS.items()]
    read = np.array(rows, float).T
    for name, column in zip(UNITS, read, strict=True):
        assert np.array_equal(column, frame[name], equal_nan=True), name


def test_mat_gives_every_bit_back(tmp_path, frame):
    frame.to_mat(tmp_path / "a.mat")

    read = loadmat(tmp_path / "a.mat", simplify_cells=True)
    for name in frame:
        assert read[name].tobytes() == np.ascontiguousarray(frame[name]).tobytes(), name
    assert read["pea"]["units"]["x2_hat"] == "m/s"
    assert read["pea"]["T_s"] == 50e-6
    assert read["pea"]["parameters"] == frame.metadata["parameters"]


def test_pandas_gives_every_bit_back(frame):
    table = frame.to_pandas()

    assert table.index.name == "t"
    assert np.array_equal(table.index, frame["t"])
    assert tuple(table.columns) == SAMPLE.names
    for name in SAMPLE.names:
        assert table[name].to_numpy().tobytes() == frame[name].tobytes()
    assert table.attrs["units"]["u"] == "V"
    assert table.attrs["parameters"]["plant"]["seed"] == 1
    assert tuple(frame.to_pandas("u", "y").columns) == ("u", "y")


def test_parquet_gives_every_bit_back(tmp_path, frame):
    frame.to_parquet(tmp_path / "a.parquet")

    table = parquet.read_table(tmp_path / "a.parquet")
    for name in frame:
        assert table[name].to_numpy().tobytes() == np.ascontiguousarray(frame[name]).tobytes()
    assert table.schema.field("y").metadata == {b"unit": b"m"}


@pytest.fixture
def few_rows(monkeypatch):
    """Every recording is read as if it were a long one, a few rows at a time."""
    monkeypatch.setattr("pea_record.frame.LONG", 1)
    monkeypatch.setattr("pea_record.contents.PIECE", 7)
    monkeypatch.setattr("pea_record.frame.Frame.recording", property(lambda frame: 1 / 0))


@pytest.fixture
def apart(bag, tmp_path, few_rows):
    """The same recording, as a long one."""
    return pea.load(shutil.copytree(bag, tmp_path / "copy"))


def test_long_recording_is_the_same_a_piece_at_a_time(frame, apart):
    assert len(apart) == N
    for name in frame:
        assert apart[name].tobytes() == frame[name].tobytes(), name
    assert apart.samples.tobytes() == frame.samples.tobytes()
    assert (apart.T_s, apart.parameters, apart.damage) == (frame.T_s, frame.parameters, "")
    sizes = [len(table["u"]) for table in apart.pieces("u")]
    assert sizes == [7] * (N // 7) + [N % 7]


def test_columns_of_a_long_recording_come_when_asked_for(apart):
    table = apart.select("u", "t")

    assert tuple(table) == ("u", "t")
    assert "samples" not in vars(apart)
    for file in apart.path.glob("*.mcap"):
        file.unlink()
    assert apart["u"].tobytes() == table["u"].tobytes()
    with pytest.raises(BagError, match="cannot be read"):
        apart["y"]


@pytest.fixture(scope="module")
def detected(tmp_path_factory):
    """A recording with a sample signal."""
    specimen = "plant.stage.specimen=exp(-x)"
    return made(tmp_path_factory.mktemp("detected") / "bag", specimen)


def test_sample_signal_of_a_long_recording_is_a_column_as_any_other(detected, request):
    whole = pea.load(detected)
    assert (whole.units["signal"], whole.recorded[-1]) == ("", "signal")
    request.getfixturevalue("few_rows")

    apart = pea.load(detected)

    assert tuple(apart) == tuple(whole)
    assert np.isfinite(whole["signal"]).all()
    assert apart["signal"].tobytes() == whole["signal"].tobytes()
    lazy = apart.to_xarray("signal")["signal"]
    assert lazy[-9:].to_numpy().tobytes() == whole["signal"][-9:].tobytes()


def test_sample_signal_of_a_part_is_that_of_its_rows(detected):
    whole, part = pea.load(detected), pea.load(detected, 0.001, 0.002)

    assert part["signal"].tobytes() == whole["signal"][20:40].tobytes()


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_long_recording_is_written_the_same(tmp_path, frame, apart, kind):
    for name, table in {"a": frame, "b": apart}.items():
        getattr(table, f"to_{kind}")(tmp_path / name)

    if kind == "csv":
        assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    else:
        read = [parquet.read_table(tmp_path / name).to_pandas() for name in "ab"]
        assert read[0].equals(read[1])


@pytest.mark.parametrize("bounds", [(0.001, 0.0035), (None, 0.002), (0.0051, None), (0.0, 9.0)])
def test_part_has_the_rows_between(bag, frame, bounds):
    part = pea.load(bag, *bounds)

    start, end = bounds[0] or 0.0, bounds[1] or 9.0
    stamps = np.arange(N) * 50_000
    inside = (stamps >= round(start * 1e9)) & (stamps < round(end * 1e9))
    assert part["t"].tobytes() == frame["t"][inside].tobytes()
    assert part.samples.tobytes() == frame.samples[inside].tobytes()


def test_part_of_a_recording_without_its_end_is_read_as_well(tmp_path, bag, frame):
    (file,) = bag.glob("*.mcap")
    (tmp_path / "a.mcap").write_bytes(file.read_bytes()[:-40])

    part = pea.load(tmp_path / "a.mcap", 0.001, 0.002)

    assert part.samples.tobytes() == frame.samples[20:40].tobytes()
    assert part.damage == "a.mcap is cut off"


@pytest.mark.parametrize(("start", "end", "why"), [
    (7.0, 8.0, "holds no whole sample from 7 s to 8 s: it reaches from 0 s to"),
    (2.0, 1.0, "the end must be after the start"), (-1.0, None, "at 0 s or later"),
    (float("nan"), None, "at 0 s or later"),
])  # fmt: skip
def test_part_that_is_none_is_refused(bag, start, end, why):
    with pytest.raises(BagError, match=why):
        pea.load(bag, start, end).samples  # noqa: B018


def test_export_writes_once(tmp_path, bag, capsys):
    asked = ["export", str(bag), "--csv", str(tmp_path / "a.csv"), "--mat", str(tmp_path / "a.mat")]
    assert cli.main(asked) == 0
    before = (tmp_path / "a.csv").read_bytes()

    assert cli.main(asked) == 2
    assert capsys.readouterr().err == f"pea: {tmp_path / 'a.csv'} already exists\n"
    assert (tmp_path / "a.csv").read_bytes() == before


def test_export_writes_parquet_with_units(tmp_path, bag, frame, capsys):
    assert cli.main(["export", str(bag), "--parquet", str(tmp_path / "a.parquet")]) == 0

    assert f"{N} samples in" in capsys.readouterr().out
    table = parquet.read_table(tmp_path / "a.parquet")
    assert table["eps_hat"].to_numpy().tobytes() == frame["eps_hat"].tobytes()
    assert {f.name: f.metadata[b"unit"].decode() for f in table.schema} == frame.units
    assert table.schema.metadata[b"experiment"] == b"fig9_hysteresis_10hz"


def test_export_of_nothing_is_refused(bag, capsys):
    assert cli.main(["export", str(bag)]) == 2
    assert "give one of --csv FILE" in capsys.readouterr().err


def test_diff_of_the_same_is_empty(tmp_path, bag, capsys):
    assert cli.main(["diff", str(bag), str(made(tmp_path / "b")), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told == {"parameters": {}, "metrics": {}, "first": None}


def test_diff_names_parameters_metrics_and_the_first_sample(tmp_path, bag, capsys):
    other = made(tmp_path / "b", "controller.P=0.002")

    assert cli.main(["diff", str(bag), str(other), "--json"]) == 3

    told = json.loads(capsys.readouterr().out)
    assert told["parameters"].keys() == {"controller.P"}
    assert told["parameters"]["controller.P"][1] == 0.002
    assert {"rms_error_nm", "trace_sha256"} <= told["metrics"].keys()
    assert (told["first"]["sample"], told["first"]["topic"]) == (0, "/pea/voltage")
