"""A recording is complete by itself: presets, references and loads from files go with it."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pea_cli import cli
from pea_core.params import ParameterError
from pea_experiment import experiments
from pea_record import frame
from pea_record.origin import ORIGIN, words
from pea_record.read import load
from pea_report import recorded

TRAJECTORY = "Time (ms);Position (nm)\n" + "".join(
    f"{1.7e12 + k / 2};{2000 - 2000 * np.cos(np.pi * k / 20):.3f}\n".replace(".", ",")
    for k in range(41)
)
LOAD = "# t (ms), f (mV)\n0 0\n5 1500\n"
LAW = "/pea/controller:\n  ros__parameters: {type: pidsmc, m: 4000.0}\n"
SETS = (
    "controller.preset=mine.yaml",
    "reference.type=file",
    "reference.path=traj.csv",
    "plant.load.type=file",
    "plant.load.path=load.csv",
)


def pea(*words):
    return cli.main([str(word) for word in words])


@pytest.fixture
def moved(tmp_path, monkeypatch):
    """A run whose files are gone, in another place than it was made in."""
    there, here = tmp_path / "there", tmp_path / "here"
    there.mkdir()
    here.mkdir()
    monkeypatch.chdir(there)
    for name, text in (("traj.csv", TRAJECTORY), ("load.csv", LOAD), ("mine.yaml", LAW)):
        (there / name).write_text(text)
    sets = [word for each in SETS for word in ("--set", each)]
    assert pea("run", "sine_series", *sets, "--duration", "0.01", "--out", "run") == 0
    shutil.move(there / "run", here / "run")
    shutil.rmtree(there)
    monkeypatch.chdir(here)
    return here / "run"


def digest(samples):
    return samples["y"].tobytes() + samples["u"].tobytes()


def test_everything_that_looks_at_a_bag_works_without_its_files(moved, tmp_path):
    (mcap,) = moved.glob("*.mcap")
    alone = tmp_path / "alone.mcap"
    shutil.copyfile(mcap, alone)
    for bag in (moved, alone):
        assert pea("bag", "check", bag) == 0
        assert pea("replay", bag) == 0
    assert pea("report", moved) == 0
    assert pea("diff", moved, alone) == 0
    assert pea("bag", "cut", alone, "--from", "0.002", "--out", tmp_path / "cut") == 0
    cut = load(tmp_path / "cut")
    again = recorded.experiment_of(cut, tmp_path / "cut")
    assert again.nodes["controller"].values["m"] == 4000.0


def test_its_parameters_run_again_to_the_bit(moved):
    assert pea("run", "run/params.yaml", "--out", "again") == 0
    assert digest(load(moved.parent / "again").samples) == digest(load(moved).samples)


def test_the_record_says_where_a_file_came_from(moved):
    record = load(moved).metadata[ORIGIN]
    assert "there/traj.csv: 41 lines of time in ms" in record["file reference.path"]
    assert not any(name.startswith("file ") for name in words(record))


def test_a_name_that_may_be_two_files_is_refused(tmp_path, monkeypatch):
    for folder, end in (("one", 0.0), ("two", 1.0)):
        (tmp_path / folder).mkdir()
        text = "".join(f"{k},{end * k}\n" for k in range(8))
        (tmp_path / folder / "w.csv").write_text(text)
    file = tmp_path / "one" / "mine.yaml"
    file.write_text("/pea/reference:\n  ros__parameters: {type: file, path: w.csv}\n")
    monkeypatch.chdir(tmp_path)
    assert experiments.load(str(file)).nodes["reference"].values["path"].endswith("one/w.csv")
    monkeypatch.chdir(tmp_path / "two")
    with pytest.raises(ParameterError, match=r"path = 'w\.csv': may be .*two/w\.csv or .*one/w"):
        experiments.load(str(file))


@pytest.mark.parametrize("ending", ["png", "NPY"])
def test_a_picture_on_the_stage_goes_with_the_run(ending, tmp_path, monkeypatch):
    there, here = tmp_path / "there", tmp_path / "here"
    there.mkdir()
    monkeypatch.chdir(there)
    grey = np.random.default_rng(1).integers(0, 256, (8, 8), np.uint8)
    if ending == "png":
        Image.fromarray(grey).save("stage.png")
    else:
        np.save(Path("x.npy"), grey)
        Path("x.npy").rename("stage.NPY")
    sets = (f"plant.stage.specimen=stage.{ending}", "plant.stage.specimen_um=[0, 0, 20, 20]")
    words = [word for each in sets for word in ("--set", each)]
    assert pea("run", "sine_series", *words, "--duration", "0.01", "--out", "run") == 0
    shutil.move(there / "run", here)
    shutil.rmtree(there)
    monkeypatch.chdir(tmp_path)
    (mcap,) = here.glob("*.mcap")
    assert pea("replay", mcap) == 0
    assert pea("run", here / "params.yaml", "--out", "again") == 0
    signals = [frame.load(Path(bag))["signal"] for bag in (mcap, "again")]
    assert len(set(signals[0])) > 10
    assert signals[0].tobytes() == signals[1].tobytes()
