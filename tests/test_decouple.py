"""``pea decouple``: the experiment that it writes has the filter in force."""

import json

import pytest

from pea_cli.cli import main
from pea_experiment import experiments

STAGE = (
    *("decouple", "fig9_hysteresis_10hz", "--set", "axes=[x, y]"),
    *("--set", "plant.stage.cross_talk=[0, 0.2, -0.1, 0]"),
    *("--set", "plant.y.omega_n=4000", "--set", "plant.hysteresis.type=none"),
)


def test_the_experiment_that_is_written_has_the_filter(tmp_path, capsys):
    there = tmp_path / "decoupled.yaml"
    assert main([*STAGE, "--taps", "6", "--out", str(there), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert max(told["found"]) < max(told["static"])
    found = experiments.load_axes(str(there))
    assert found.axes == ("x", "y")
    for one in found.each:
        assert list(one.nodes["plant"].params.stage.axes_to_actuators) == told["axes_to_actuators"]
    assert len(told["axes_to_actuators"]) == 24


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("decouple", "fig9_hysteresis_10hz"), "has one axis"),
        ((*STAGE, "--taps", "0"), "--taps"),
        ((*STAGE, "--to", "20000"), "--to 20000 Hz"),
        ((*STAGE, "--out", "README.md"), "exists"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(words, said, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "README.md").touch()
    assert main(list(words)) == 2
    err = capsys.readouterr().err
    assert said in err
    assert err.count("\n") == 1
