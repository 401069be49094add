"""A recording in the formats of other tools, each read back by a library of its own."""

import h5py
import numpy as np
import pytest
import xarray
from scipy.io import loadmat

import pea
from pea_cli.cli import main
from pea_core.units import SECOND
from pea_experiment import experiments
from pea_record import frame as frames
from pea_run.modes import batch

N = 200


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    there = tmp_path_factory.mktemp("run") / "bag"
    experiment = experiments.load("sine_series", (), N * 50e-6)
    batch.run(experiment, there, lambda k: None)
    return there


def test_each_format_holds_every_column_its_unit_and_the_truth(bag, tmp_path, capsys):
    files = {kind: tmp_path / f"run.{kind}" for kind in ("hdf5", "netcdf", "mat", "csv")}
    words = [word for kind, path in files.items() for word in (f"--{kind}", str(path))]
    assert main(["export", str(bag), "--truth", *words]) == 0
    run = pea.load(bag, truth=True)
    assert {"x1", "x2", "eps"} <= set(run)
    with h5py.File(files["hdf5"]) as file, xarray.open_dataset(files["netcdf"]) as table:
        mat = loadmat(files["mat"])
        for name, unit in run.units.items():
            assert file[name].attrs["units"] == table[name].attrs["units"] == unit
            for found in (file[name][:], table[name].to_numpy(), mat[name].ravel()):
                assert np.array_equal(found, run[name], equal_nan=True)
        assert table.attrs["experiment"] == "sine_series"
    head = files["csv"].read_text().splitlines()[0]
    assert head.endswith("x1 [m],x2 [m/s],eps [V]")


def test_the_truth_is_the_measurement_without_noise(bag):
    run = pea.load(bag, truth=True)
    noise = run["y"] - run["x1"]
    assert 0.0 < np.std(noise) < 5e-9
    part = pea.load(bag, start=20 * 50e-6, end=40 * 50e-6, truth=True)
    assert np.array_equal(part["x1"], run["x1"][20:40])


def test_a_dataset_of_a_long_recording_reads_only_what_is_asked_for(bag, monkeypatch):
    whole = pea.load(bag).to_xarray()
    monkeypatch.setattr(frames, "LONG", 1)
    run = pea.load(bag)
    read = []
    plain = type(run).__getitem__
    monkeypatch.setattr(
        type(run), "__getitem__", lambda self, name: read.append(name) or plain(self, name)
    )
    lazy = run.to_xarray("y", "u")
    assert read.count("y") == 0
    part = lazy["y"].isel(t=slice(50, 60))
    assert np.array_equal(part.to_numpy(), whole["y"].to_numpy()[50:60])
    assert lazy["u"].isel(t=7).item() == whole["u"].isel(t=7).item()
    near = lazy["y"].sel(t=100 * 50_000 / SECOND, method="nearest")
    assert near.item() == whole["y"].to_numpy()[100]


def test_systems_are_those_of_python_control():
    import control

    found = pea.systems("fig9_hysteresis_10hz")
    assert isinstance(found["plant"], control.StateSpace)
    assert found["loop"].dt == 50e-6


def test_without_a_format_one_line_names_them(bag, capsys):
    assert main(["export", str(bag)]) == 2
    assert "--netcdf FILE" in " ".join(capsys.readouterr().err.split())
