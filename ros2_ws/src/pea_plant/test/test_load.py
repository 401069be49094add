import math

import numpy as np
import pytest

from pea_core.params import ParameterError, build
from pea_plant.drivers.simulated import Params, Simulated
from pea_plant.model.load import CHOICE, MODELS, file

T_S = 50e-6


def values_of(values, samples, T_s=T_S, K=0.142):
    """Volts-equivalent load at samples 0, 1, ..."""
    params = build(CHOICE, values)
    model = MODELS[CHOICE.type_of(params)]
    c = model.design(params, T_s, K)
    return [model.output(c, k) for k in range(samples)]


def displacements(values, voltages):
    plant = Simulated(build(Params, values), T_S)
    y = []
    for u in voltages:
        y.append(plant.read().y)
        plant.write(u)
    return np.array(y), plant


def csv(tmp_path, text):
    path = tmp_path / "load.csv"
    path.write_text(text)
    return str(path)


def test_step_comes_at_its_time():
    f_e = values_of({"type": "step", "amplitude": 3.0, "time": 4 * T_S}, 7)
    assert f_e == [0.0] * 4 + [3.0] * 3


def test_sine_is_the_sine():
    f_e = values_of(
        {"type": "sine", "amplitude": 2.0, "offset": 1.0, "frequency_hz": 50.0, "phase_deg": 30.0},
        400,
    )
    t = np.arange(400) * T_S
    np.testing.assert_allclose(f_e, 1 + 2 * np.sin(100 * np.pi * t + np.pi / 6), atol=1e-12)


def test_file_is_linear_between_its_points_and_holds_its_ends(tmp_path):
    path = csv(tmp_path, "time,load\n# seconds, volts\n0.1,1\n0.2,3\n\n0.4,-1\n")
    f_e = values_of({"type": "file", "path": path}, 7, T_s=0.1)
    assert f_e == pytest.approx([1.0, 1.0, 3.0, 1.0, -1.0, -1.0, -1.0])


def test_newtons_move_the_actuator_as_its_stiffness_says():
    load = {"load.type": "step", "load.unit": "N", "load.amplitude": 60.0, "load.stiffness": 20.0}
    for V in ({}, {"vibration.type": "modal"}):
        y, _ = displacements({**load, **V, "K": 0.2}, [0.0] * 4000)
        assert y[-1] * 1e6 == pytest.approx(3.0, rel=1e-6)


@pytest.mark.parametrize("creeping", [False, True])
def test_volts_of_load_act_as_volts_of_command_without_hysteresis(creeping):
    common = {"creep.enabled": creeping}
    load = {
        "load.type": "sine",
        "load.amplitude": 5.0,
        "load.offset": 5.0,
        "load.frequency_hz": 200.0,
    }
    y, plant = displacements({**common, **load}, [0.0] * 200)
    f_e = values_of({"type": "sine", "amplitude": 5.0, "offset": 5.0, "frequency_hz": 200.0}, 200)
    expected, commanded = displacements(common, f_e)
    np.testing.assert_allclose(y, expected, atol=1e-18)
    assert plant.truth == pytest.approx(commanded.truth, rel=1e-9)


def test_load_does_not_pass_the_hysteresis():
    for kind in ("bouc_wen", "prandtl_ishlinskii", "preisach"):
        y, _ = displacements(
            {"hysteresis.type": kind, "load.type": "step", "load.amplitude": 10.0}, [0.0] * 400
        )
        assert y[-1] == pytest.approx(1.42e-6, rel=1e-6)


def test_load_is_part_of_the_lumped_unknown_input():
    _, plant = displacements({"load.type": "step", "load.amplitude": 7.0}, [20.0] * 30)
    x1, x2, x2_dot = plant.truth
    B_2 = 0.142e-6 * 5450.0**2
    eps = (x2_dot + 5450.0**2 * x1 + 2 * 0.82 * 5450.0 * x2) / B_2 - 20.0
    assert eps == pytest.approx(7.0, rel=1e-9)


def test_a_changed_file_is_read_again(tmp_path):
    path = csv(tmp_path, "0,1\n1,1\n")
    assert values_of({"type": "file", "path": path}, 1) == [1.0]
    csv(tmp_path, "0,25\n1,25\n")
    assert values_of({"type": "file", "path": path}, 1) == [25.0]


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("0,1\n", "has 1 points, two are needed"),
        ("", "has no line of two numbers"),
        ("0,1\n1,2\n1,3\n", "line 3 has 1 s after 1 s"),
        ("0,1\n2,2\n1,3\n", "line 3 has 1 s after 2 s"),
        ("0,1\n1,a\n", "line 2 must be two numbers"),
        ("0,1\n1\n", "line 2 must be two numbers"),
        ("0,1\n1,2,3\n", "line 2 must be two numbers"),
        ("0,1\n1,nan\n", "line 2 is not finite"),
        ("0,1\ninf,1\n", "line 2 is not finite"),
        ("0,1\n1,1e12\n", "numbers must be finite, values within 1e"),
        ("0,1\n1e9,1\n", "at most 1000 s are allowed"),
        ("0.000000,\n0,1\n1,2\n", "line 1 must be two numbers"),
        ("Time (ms),Force (N)\n0,1\n1,2\n", "line 1 has a value in none of V, mV, kV"),
    ],
)
def test_a_bad_file_is_refused_by_its_line(tmp_path, text, rule):
    with pytest.raises(ParameterError, match=rule) as refusal:
        values_of({"type": "file", "path": csv(tmp_path, text)}, 1)
    assert "load.csv" in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_load_may_be_stamped_with_the_time_of_day(tmp_path):
    plain = values_of({"type": "file", "path": csv(tmp_path, "0,0\n1,20000\n")}, 5)
    late = csv(tmp_path, "1732900000.0,0\n1732900001.0,20000\n")
    assert values_of({"type": "file", "path": late}, 5) == plain


def test_units_of_the_head_count(tmp_path):
    path = csv(tmp_path, "time (ms);f [mN]\n0;0\n1;2000,5\n")
    found = file.read(file.Params(path=path, unit="N", stiffness=10.0))
    assert found.time.tolist() == [0.0, 0.001]
    assert found.value.tolist() == [0.0, 2.0005]
    assert "value in mN ('f [mN]')" in found.understood


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(ParameterError, match=r"none\.csv': No such file"):
        file.read(file.Params(path=str(tmp_path / "none.csv")))


def test_a_file_that_is_no_text_is_refused(tmp_path):
    path = tmp_path / "load.csv"
    path.write_bytes(b"\xff\xfe\x00\x81\x8d")
    with pytest.raises(ParameterError, match="is no text of separated values"):
        file.read(file.Params(path=str(path)))


@pytest.mark.parametrize(
    ("values", "rule"),
    [
        ({"type": "file"}, "path = '': name a text file"),
        ({"type": "step", "unit": "N"}, "stiffness = 0: a load in newtons needs"),
        ({"type": "step", "unit": "kg"}, "unit = 'kg'"),
    ],
)
def test_a_load_without_its_facts_is_refused(values, rule):
    with pytest.raises(ParameterError, match=rule):
        build(CHOICE, values)


def test_no_load_is_zero():
    assert values_of({}, 2) == [0.0, 0.0]
    assert not math.copysign(1.0, values_of({}, 1)[0]) < 0.0
