"""Axes that are named wrongly: one line each."""

import pytest

from pea_cli import cli
from pea_core.params import ParameterError
from pea_experiment import experiments

TWO = "axes=[x, y]"


@pytest.mark.parametrize(
    ("sets", "told"),
    [
        (["axes=[x, x]"], "'x' is named twice"),
        (["axes=[a, b, c, d, e, f, g]"], "give 1 to 6 names"),
        (["axes=[]"], "give 1 to 6 names"),
        (["axes=[x, a.b]"], "'a.b' is no name"),
        (["axes=[x, P]"], "'P' is a parameter of the controller"),
        (["axes=[x, hysteresis]"], "'hysteresis' is a parameter of the plant"),
        (["axes=[x, K_p]"], "'K_p' is a parameter of the controller"),
        ([TWO, "plant.z.K=0.1"], "unknown parameter plant.z.K: no axis 'z'; give one of plant.x.K"),
        ([TWO, "controller.z.inject.where=off"], "no axis 'z'"),
        ([TWO, "plant.x=3"], "x is an axis"),
        ([TWO, "plant.y.Kk=0.1"], "unknown parameter plant.y.Kk: did you mean plant.y.K?"),
        ([TWO, "plant.y.T_s=0.1"], "T_s is one for all axes; give plant.T_s"),
        ([TWO, "controller.x.axes=[x]"], "axes is one for all axes; give controller.axes"),
        ([TWO, "controller.axes=[x]"], "differs from plant.axes"),
        (["plant.x.K=0.1"], "unknown parameter plant.x.K"),
    ],
)
def test_wrong_axes_are_refused(sets, told):
    with pytest.raises(ParameterError) as error:
        experiments.load_axes("fig9_hysteresis_10hz", sets)
    assert told in str(error.value)
    assert "\n" not in str(error.value)


def test_what_takes_one_axis_says_so(capsys, tmp_path):
    there = str(tmp_path / "a.fmu")
    assert cli.main(["fmu", "fig9_hysteresis_10hz", "--out", there, "--set", TWO]) == 2
    said = capsys.readouterr().err.strip()
    assert said.count("\n") == 0
    assert "and this takes one: write fig9_hysteresis_10hz@x" in said
