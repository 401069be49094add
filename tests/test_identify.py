"""`pea identify` and `pea simulate-from`, as a user types them."""

import json

import numpy as np
import pytest

from pea_cli.cli import main
from pea_experiment import experiments
from pea_identify import excitation, hysteresis
from pea_identify.modes import Modes

T_s = 1e-4


def saved(path, u, y):
    t = np.arange(len(u)) * T_s
    np.savetxt(
        path,
        np.column_stack([t, u, y * 1e6]),
        "%.10g",
        ",",
        header="t [s],u [V],y [um]",
        comments="",
    )
    return path


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A multisine and triangles of a stage with one mode, 2.5 samples late, and Bouc-Wen."""
    there = tmp_path_factory.mktemp("data")
    none = np.zeros(1)
    V = Modes(
        np.array([5000.0]),
        np.array([0.05]),
        np.array([[[1.4e-7]]]),
        2.5 * T_s,
        0.0,
        none,
        none,
        np.zeros((1, 1, 1)),
        0.0,
        0.0,
        np.zeros((1, 1)),
        1.0,
        T_s,
    )
    rng = np.random.default_rng(1)
    lines = excitation.lines_between(20.0, 4000.0, 1000, T_s)
    u = np.concatenate([np.tile(excitation.multisine(1000, lines, 0.3, rng), 3) for _ in range(3)])
    slow = excitation.triangles(0.0, (60.0, 40.0, 50.0, 20.0), 1500)
    made = []
    for name, drive in (("fast", u), ("slow", slow)):
        v = hysteresis.driven("bouc_wen", {"alpha": 0.3, "beta": 0.03, "gamma": 0.01}, drive)
        y = V.simulate(v[:, None])[:, 0] + 1e-10 * rng.standard_normal(len(v))
        made.append(saved(there / f"{name}.csv", drive, y))
    return made


def test_files_to_a_plant_that_runs(data, tmp_path, capsys):
    there = tmp_path / "mine"
    files = [str(path) for path in data]
    options = ["--hysteresis", "bouc_wen", "--modes", "2", "--out", str(there), "--json"]
    assert main(["identify", *files, *options]) == 0
    told = json.loads(capsys.readouterr().out)
    (mode,) = (m for m in told["modes"] if m["share"] > 0.5)
    assert mode["frequency_hz"]["value"] == pytest.approx(5000.0 / (2 * np.pi), rel=1e-3)
    assert told["delay_us"]["value"] == pytest.approx(250.0, abs=2.0)
    assert told["hysteresis"]["type"] == "bouc_wen"
    assert (there / "page.html").stat().st_size > 20_000
    plant = there / "plant.yaml"
    sets = [f"plant.preset={plant}", f"T_s={T_s}"]
    experiment = experiments.load("fig9_hysteresis_10hz", sets, duration=0.01)
    assert len(experiment.loop().run(100)) == 100
    slow = str(data[1])
    assert main(["simulate-from", slow, "--plant", str(plant), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["percent_of_stroke"] < 0.2


@pytest.mark.parametrize("where", ["voltage", "reference"])
def test_a_recording_of_a_running_loop_to_a_plant_that_runs(where, tmp_path, capsys):
    """Noise that the law sends back makes u hardly periodic: the parameters say the periods."""
    inject = {"where": where, "from_hz": 20, "to_hz": 4000, "period": 0.05, "periods": 2}
    inject |= {"realisations": 3, "wait": 0.1, "amplitude_V": 0.5, "amplitude_um": 0.01}
    sets = [f"controller.inject.{name}={value}" for name, value in inject.items()]
    sets += ["reference.type=constant"]
    bag, there = tmp_path / "bag", tmp_path / "mine"
    options = [word for text in sets for word in ("--set", text)]
    assert main(["run", "sine_series", "--duration", "0.6", "--out", str(bag), *options]) == 0
    capsys.readouterr()
    assert main(["identify", str(bag), "--modes", "2", "--out", str(there), "--json"]) == 0
    said = capsys.readouterr()
    assert "3 realisations injected" in said.err
    told = json.loads(said.out)
    (mode,) = (m for m in told["modes"] if m["share"] > 0.5)
    assert mode["frequency_hz"]["value"] == pytest.approx(5450.0 / (2 * np.pi), rel=0.02)
    # K times the slope after a turn; the creep and the loops of the motion are in it
    assert told["gain_um_per_V"]["value"] == pytest.approx(0.142 * 0.51, rel=0.06)
    sets = [f"plant.preset={there / 'plant.yaml'}", "reference.type=constant"]
    experiment = experiments.load("sine_series", sets, duration=0.01)
    assert len(experiment.loop().run(100)) == 100


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--kind", "loud"], "unknown kind"),
        (["--u", "w:V"], "no column"),
        (["--rate", "0"], "--rate"),
        (["--modes", "none"], "--modes"),
        (["--hold", "first"], "--hold"),
        (["--period", "700", "--kind", "periodic"], "does not repeat"),
    ],
)
def test_bad_input_is_one_line_and_status_2(options, words, data, tmp_path, capsys):
    status = main(["identify", str(data[0]), "--out", str(tmp_path / "x"), *options])
    said = capsys.readouterr().err.strip()
    assert status == 2
    assert words in said
    assert "Traceback" not in said
    assert not (tmp_path / "x").exists()
