"""``pea image``: maps of a recorded scan, in files that others read; bad input in one line."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pea_cli import cli
from pea_record import frame

SETS = (
    "axes=[x, y]", "reference.type=raster", "reference.x.part=line", "reference.y.part=frame",
    "reference.lines=2", "reference.pixels=8", "reference.line_rate_hz=40", "T_s=0.0001",
    "reference.flyback_lines=1", "reference.width_um=6", "reference.height_um=6",
)  # fmt: skip


def run(there, *more):
    words = [word for each in (*SETS, *more) for word in ("--set", each)]
    experiment = ("run", "fig9_hysteresis_10hz", "--duration", "0.12", "--force")
    assert cli.main([*experiment, *words, "--out", str(there)]) == 0
    return str(there)


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return run(tmp_path_factory.mktemp("image") / "raster", "plant.stage.specimen=x+100*y")


def test_maps_of_a_raster_are_written(bag, tmp_path, capsys):
    Image.fromarray(np.tile(np.arange(0, 256, 4, np.uint8), (64, 1))).save(tmp_path / "ramp.png")
    files = [str(tmp_path / name) for name in ("a.png", "a.npz", "a.h5")]
    outs = [word for file in files for word in ("--out", file)]
    signal = ("--signal", str(tmp_path / "ramp.png"))
    assert cli.main(["image", bag, *outs, *signal, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["files"] == files
    assert list(told["pictures"])[:2] == ["frame 0 forward", "frame 0 backward"]
    with np.load(files[1]) as found:
        assert found["x_um"].shape == (len(told["pictures"]), 2, 8)
        error = found["error_nm"][0]
        rms = np.sqrt(np.nanmean(error**2))
        assert rms == pytest.approx(told["pictures"]["frame 0 forward"]["rms_error_distance_nm"])
        forward, backward = found["signal"][:2]
        assert (np.diff(forward, axis=1) > 0).all()
        np.testing.assert_allclose(forward, backward, atol=0.1)
    with Image.open(files[0]) as picture:
        assert picture.format == "PNG"


def test_the_sample_signal_that_was_recorded_is_the_grey_value(bag, tmp_path):
    assert cli.main(["image", bag, "--out", str(tmp_path / "a.npz")]) == 0
    with np.load(tmp_path / "a.npz") as found:
        there = np.isfinite(found["x_um"])
        wanted = found["x_um"] + 100.0 * found["y_um"]
        assert there.sum() > 20
        np.testing.assert_allclose(found["signal"][there], wanted[there], rtol=1e-6)
    table = frame.load(Path(bag))
    assert table["signal"] == pytest.approx(1e6 * (table["x.y"] + 100.0 * table["y.y"]), rel=1e-6)


def test_a_specimen_that_is_none_is_refused_before_anything_runs(tmp_path, capsys):
    words = ["--out", str(tmp_path / "x"), "--set", "plant.stage.specimen=sin(z)"]
    assert cli.main(["run", "fig9_hysteresis_10hz", *words]) == 2
    assert "stage.specimen = 'sin(z)': no 'z'; it has" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_by_default_the_picture_is_in_the_bag(bag, capsys):
    assert cli.main(["image", bag]) == 0
    said = capsys.readouterr().out
    assert "frame 0 forward" in said
    assert "image.png" in said


def test_the_figure_of_two_axes_begins_with_their_path(bag, tmp_path):
    file = tmp_path / "a.svg"
    assert cli.main(["figure", bag, "--out", str(file)]) == 0
    assert ">Path of x and y<" in file.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("--out", "a.jpg"), "--out a.jpg: must end in .png, .svg, .npz, .h5"),
        (("--out", "none/a.png"), "--out none/a.png: no such directory"),
        (("--signal", "none.png"), "--signal none.png: No such file"),
        (("--pixels", "0"), "--pixels = '0': must be 1 to 8192"),
        (("--tolerance", "2"), "--tolerance: the scan reaches no point of a list"),
    ],
)
def test_bad_input_is_one_line(bag, words, text, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    assert cli.main(["image", bag, *words]) == 2
    said = capsys.readouterr().err
    assert text in said
    assert said.count("\n") == 1


def test_a_recording_of_one_axis_is_refused(tmp_path, capsys):
    there = tmp_path / "one"
    assert cli.main(["run", "fig9_hysteresis_10hz", "--duration", "0.05", "--out", str(there)]) == 0
    capsys.readouterr()
    assert cli.main(["image", str(there)]) == 2
    assert "has one axis, x: a picture needs two" in capsys.readouterr().err


def test_two_axes_of_one_scan_share_its_parameters(capsys):
    words = [word for each in (*SETS, "reference.y.lines=3") for word in ("--set", each)]
    assert cli.main(["run", "fig9_hysteresis_10hz", *words]) == 2
    said = capsys.readouterr().err
    assert "reference.y.lines = 3: differs from reference.x.lines = 2; a raster has one" in said
    words = [word for each in (*SETS, "reference.y.part=line") for word in ("--set", each)]
    assert cli.main(["run", "fig9_hysteresis_10hz", *words]) == 2
    assert "the axis x has this part of the raster already" in capsys.readouterr().err
