"""What every reference must do: compile to the same bits, stay finite, keep its precision."""

import math
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pea_core.block import Signal
from pea_core.params import ParameterError, build, specs
from pea_reference.model import MODELS

T_S = 50e-6
DAY = 24 * 3600 * 20000  # samples

VARIANTS = [
    ("constant", {"offset_um": 3.0}),
    ("step", {}),
    ("step", {"shape": "minimum_jerk"}),
    ("step", {"shape": "filtered"}),
    ("sine", {}),
    ("sine_series", {"frequencies_hz": [100.0, 150.0], "periods": [1.0]}),
    ("multisine", {}),
    ("chirp", {"sweep_time": 0.01}),
    ("chirp", {"sweep_time": 0.01, "sweep": "logarithmic"}),
    ("triangle", {"frequency_hz": 100.0}),
    ("file", {}),
    ("file", {"ends": "periodic"}),
    ("raster", {"line_rate_hz": 100.0, "part": "line"}),
    ("raster", {"line_rate_hz": 100.0, "part": "frame", "lines": 2}),
    ("raster", {"line_rate_hz": 100.0, "part": "frame", "motion": "continuous"}),
    ("spiral", {"frame_time_s": 0.05}),
    ("spiral", {"frame_time_s": 0.15, "velocity": "linear", "part": "y"}),
    ("lissajous", {"frame_time_s": 0.1}),
    ("points", {}),
]


MOVING = ("sine", "sine_series", "multisine", "chirp", "triangle", "file")
"""References that move from their first samples on."""


@pytest.fixture(scope="session")
def jitted(compiled):
    return {name: compiled(model.output) for name, model in MODELS.items()}


@pytest.mark.parametrize(("name", "values"), VARIANTS)
def test_compiled_reference_gives_the_same_bits(name, values, jitted, tmp_path):
    if name == "file":
        path = tmp_path / "w.csv"
        path.write_text(
            "".join(f"{0.001 * i},{math.sin(i) if i < 14 else 0.0}\n" for i in range(15))
        )
        values = {**values, "path": str(path)}
    if name == "points":
        path = tmp_path / "points.csv"
        path.write_text("x,dwell\n1,0.001\n2,0.003\n")
        values = {**values, "path": str(path)}
    model = MODELS[name]
    c = model.design(build(model.Params, values), T_S)
    assert model.output(c, 30) != model.output(c, 0) or name not in MOVING
    for k in [*range(300), *range(300, 4000, 13), *range(DAY, DAY + 50)]:
        assert jitted[name](c, k) == model.output(c, k)


def cycle(f, k):
    """Exact phase (rad, within a turn) after k samples of 50 us."""
    return 2 * math.pi * float(Fraction(f) * k * Fraction(50, 10**6) % 1)


@pytest.mark.parametrize("k", [DAY + i for i in (0, 17, 4321, 99999)])
@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("sine", {"frequency_hz": 150.0, "phase_deg": -90.0}),
        ("multisine", {"frequencies_hz": [150.0], "amplitudes_um": [5.0], "phases": "listed",
                       "phases_deg": [-90.0]}),
        ("sine_series", {"frequencies_hz": [150.0], "periods": [30.0]}),
        ("chirp", {"frequency_start_hz": 150.0, "frequency_end_hz": 150.0}),
    ],
)  # fmt: skip
def test_after_a_day_the_phase_is_still_exact(name, values, k):
    W = Signal(MODELS[name], build(MODELS[name].Params, values), T_S).at(k)
    angle, omega = cycle(150, k), 2 * math.pi * 150.0
    assert W.w == pytest.approx(5e-6 - 5e-6 * math.cos(angle), abs=1e-12)
    assert W.w_dot == pytest.approx(5e-6 * omega * math.sin(angle), abs=1e-9)
    assert W.w_ddot == pytest.approx(5e-6 * omega**2 * math.cos(angle), abs=1e-6)


@pytest.mark.parametrize("k", [DAY + 17, DAY + 4321])
def test_after_a_day_a_triangle_keeps_its_phase(k):
    params = {"frequency_hz": 150.0, "rounding": 0.5}
    signal = Signal(MODELS["triangle"], build(MODELS["triangle"].Params, params), T_S)
    early = k % 400  # three periods
    assert signal.at(k).w == pytest.approx(signal.at(early).w, abs=1e-12)


def admissible(spec):
    if spec.kind is tuple:
        return st.lists(st.floats(spec.low, spec.high), max_size=4)
    if spec.choices:
        return st.sampled_from(spec.choices)
    if spec.kind is int:
        return st.integers(spec.low, spec.high)
    if spec.kind is bool:
        return st.booleans()
    if spec.kind is str:
        return st.just("")
    return st.floats(spec.low, spec.high)


@pytest.mark.parametrize("name", [n for n in MODELS if n not in ("file", "points")])
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_any_admissible_parameters_give_finite_references_or_a_refusal(name, data):
    known = specs(MODELS[name].Params)
    slow = ("shaper.spread", "shaper.tolerance")  # of the type robust, which designs for seconds
    values = {n: data.draw(admissible(s), n) for n, s in known.items() if n not in slow}
    if values["shaper.type"] == "robust":
        values["shaper.type"] = "zv"
    T_s = data.draw(st.sampled_from([1e-6, 50e-6, 1e-3]))
    try:
        signal = Signal(MODELS[name], build(MODELS[name].Params, values), T_s)
    except ParameterError:
        return
    for k in (0, 1, data.draw(st.integers(0, 10**10))):
        assert all(math.isfinite(x) for x in signal.at(k))
