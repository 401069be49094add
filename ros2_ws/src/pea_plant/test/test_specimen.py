"""What lies on a simulated stage: formulas, pictures, and where the stage truly is."""

import numpy as np
import pytest

from pea_core.params import ParameterError
from pea_plant import drivers, specimen
from pea_plant.model.stage import Params as Stage
from pea_plant.plant import Params

UM = 1e-6
AREA = (5.0, 4.0, 4.0, 2.0)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("x + 10*y", 23.0),
        ("sin(pi*x/6)", 1.0),
        ("where(x > 2, 1, -1) + hypot(x, 4) % 3", 3.0),
        ("2**3 - 0.5", 7.5),
    ],
)
def test_a_formula_has_x_and_y_in_um(text, value):
    signal = specimen.specimen(text, ())
    x, y = np.array([3.0, 3.0]) * UM, np.array([2.0, 2.0]) * UM
    np.testing.assert_allclose(specimen.at(signal, (x, y)), [value, value], rtol=1e-12)


def test_one_axis_is_x_and_what_is_not_known_stays_so():
    signal = specimen.specimen("x - y", ())
    found = specimen.at(signal, [np.array([1.0, np.nan]) * UM])
    assert found[0] == pytest.approx(1.0)
    assert np.isnan(found[1])


def test_a_picture_covers_its_area_and_its_edge_counts_beyond(tmp_path):
    path = tmp_path / "there.npy"
    np.save(path, np.array([[0.0, 1.0], [10.0, 11.0]]))
    signal = specimen.specimen(str(path), AREA)
    x, y = np.array([4.0, 6.0, 5.0, 99.0]), np.array([3.5, 4.5, 4.0, -99.0])
    np.testing.assert_allclose(specimen.at(signal, (x * UM, y * UM)), [0, 11, 5.5, 1], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "area", "words"),
    [
        ("x +", (), "is no formula"),
        ("z*x", (), "no 'z'; it has abs, cos"),
        ("open('f')", (), "give a formula"),
        ("x.real", (), "give a formula of x and y"),
        ("sin", (), "cannot be computed"),
        ("sin(x=3)", (), "give a formula"),
        ("9**9**9**9", (), "cannot be computed"),
        ("'a'", (), "'a' is no number"),
        ("x+" * 300 + "x", (), "is no formula"),
        ("no.png", (), "give what the picture covers"),
        ("no.png", AREA, "No such file"),
    ],
)
def test_what_is_no_specimen_is_refused_by_name(text, area, words):
    plant = Params(stage=Stage(specimen=text, specimen_um=area))
    with pytest.raises(ParameterError, match=rf"stage\.specimen.*{words}"):
        specimen.of([plant])


def test_a_simulated_driver_has_the_signal_of_where_the_stage_truly_is():
    plant = Params(stage=Stage(specimen="100*x"))
    bare, driver = drivers.make(Params(), 1e-3), drivers.make(plant, 1e-3)
    for u in (20.0, 40.0, 60.0):
        assert driver.exchange(u) == bare.exchange(u)
        before = driver.signal
    assert before == pytest.approx(100.0 * 1e6 * _true(40.0), rel=1e-9)
    assert not hasattr(bare, "signal")
    two = drivers.make((plant, plant), 1e-3)
    two.exchange((20.0, 30.0))
    two.exchange((20.0, 30.0))
    assert two.signal == pytest.approx(100.0 * 1e6 * _true(20.0, 1), rel=1e-9)


def _true(last, samples=2):
    """Where the stage is after commands up to `last`, without anything else."""
    alone = drivers.make(Params(), 1e-3)
    for u in (20.0, 40.0)[:samples]:
        alone.exchange(u)
    alone.read()
    return alone.truth.x1
