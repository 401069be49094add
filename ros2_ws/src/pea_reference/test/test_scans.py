"""Scans: derivatives, limits, paths and events against answers from elsewhere."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.interpolate import make_interp_spline
from scipy.spatial import cKDTree

from pea_core.block import Signal
from pea_core.params import ParameterError, build
from pea_reference.model import MODELS, points
from pea_reference.model.scan import FRAME, LINE, PIXEL, POINT

T_S = 50e-6

LIST = "# three corners\nx [um],y [nm],dwell [ms]\n1,2000,10\n4.0,2500,20\n4.0,0,0\n"

SCANS = [
    ("raster", {"part": "line"}),
    ("raster", {"part": "frame", "lines": 5}),
    ("raster", {"part": "frame", "lines": 5, "motion": "continuous"}),
    ("spiral", {"part": "x"}),
    ("spiral", {"part": "y", "velocity": "linear"}),
    ("lissajous", {"part": "x"}),
    ("lissajous", {"part": "y"}),
    ("points", {"part": "y", "shaper.velocity_max": 100.0, "shaper.jerk_max": 1e9}),
]


@pytest.fixture
def listed(tmp_path):
    path = tmp_path / "points.csv"
    path.write_text(LIST)
    return str(path)


def signal(name, values, T_s=T_S):
    model = MODELS[name]
    return Signal(model, build(model.Params, values), T_s)


def rows(one, first, last):
    return np.array([one.at(k) for k in range(first, last)])


def period(one):
    ((begin, _, length),) = one.model.segments(one.params)
    return begin, length


@pytest.mark.parametrize(("name", "values"), SCANS)
def test_derivatives_are_those_of_a_spline_through_w(name, values, listed):
    if name == "points":
        values = {**values, "path": listed}
    begin, length = period(signal(name, values))
    T_s = (begin + length) / 20_000
    W = rows(signal(name, values, T_s), 0, 21_000)
    t = np.arange(len(W)) * T_s
    spline = make_interp_spline(t, W[:, 0], k=5)
    inside = slice(20, -20)
    for order in (1, 2):
        found = spline.derivative(order)(t)[inside]
        peak = np.abs(W[:, order]).max()
        error = np.abs(found - W[inside, order])
        # the jerk jumps between two moves, where no spline follows at once
        assert np.quantile(error, 0.99) < 3e-4 * peak
        assert error.max() < 0.05 * peak


@pytest.mark.parametrize(("name", "values"), SCANS)
def test_it_repeats_after_a_period(name, values, listed):
    if name == "points":
        values = {**values, "path": listed}
    begin, length = period(signal(name, values))
    T_s = length / 4000
    one = signal(name, values, T_s)
    first = math.ceil(begin / T_s)
    peaks = np.abs(rows(one, first, first + 4000)).max(axis=0)
    for number in (1, 10**6):
        shift = 4000 * number
        for k in range(first, first + 4000, 97):
            early, late = one.at(k), one.at(k + shift)
            for values, scale in zip(zip(early, late, strict=True), peaks, strict=True):
                assert values[0] == pytest.approx(values[1], abs=1e-6 * scale)


@pytest.mark.parametrize("name", ["raster", "spiral", "lissajous"])
@pytest.mark.parametrize("part", [0, 1])
def test_it_begins_at_rest(name, part):
    one = signal(name, {"part": MODELS[name].PARTS[part]}, 1e-6)
    assert one.at(0)[1:] == (0.0, 0.0)


VALUES = {
    "raster": {
        "part": st.sampled_from(["line", "frame"]),
        "motion": st.sampled_from(["step", "continuous"]),
        "width_um": st.floats(0.01, 100.0),
        "height_um": st.floats(0.01, 100.0),
        "lines": st.integers(2, 200),
        "flyback_lines": st.integers(1, 20),
        "line_share": st.floats(0.05, 0.98),
        "line_rate_hz": st.floats(0.1, 100.0),
        "pixels": st.just(1),
    },
    "spiral": {
        "part": st.sampled_from(["x", "y"]),
        "velocity": st.sampled_from(["angular", "linear"]),
        "diameter_um": st.floats(0.01, 100.0),
        "turns": st.integers(8, 60),
        "inner_turns": st.integers(1, 7),
        "return_turns": st.integers(1, 7),
        "frame_time_s": st.floats(0.1, 100.0),
    },
    "lissajous": {
        "part": st.sampled_from(["x", "y"]),
        "width_um": st.floats(0.1, 100.0),
        "height_um": st.floats(0.1, 100.0),
        "resolution_um": st.floats(0.1, 10.0),
        "frame_time_s": st.floats(0.1, 100.0),
        "start": st.floats(0.001, 1.0),
    },
}


@pytest.mark.parametrize("name", VALUES)
@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_motion_is_continuous_and_within_its_bounds(name, data):
    """Each derivative moves as the next one says: the mean value theorem with the bounds."""
    values = {n: data.draw(s, n) for n, s in VALUES[name].items()}
    model = MODELS[name]
    params = build(model.Params, values)
    begin, length = period(Signal(model, params, 1e-7))
    v, a, j = model.bounds(params)
    T_s = 1e-3 * min(v / a, a / j)
    one = Signal(model, params, T_s)
    first = data.draw(st.integers(0, int((begin + 1.5 * length) / T_s)), "first")
    W = rows(one, first, first + 40)
    slack = 1.0 + 1e-9
    eps = 1e-15 * np.abs(W[:, 0]).max()
    late = 1e-15 * (1.0 + first)  # rounding of the time
    assert np.abs(W[:, 1]).max() <= v * slack
    assert np.abs(W[:, 2]).max() <= a * slack
    assert np.abs(np.diff(W[:, 2])).max() <= j * T_s * (slack + late) + 1e-9 * a
    mean = 0.5 * (W[1:] + W[:-1])
    assert np.abs(np.diff(W[:, 1]) - T_s * mean[:, 2]).max() <= j * T_s**2 + 1e-9 * v
    assert (
        np.abs(np.diff(W[:, 0]) - T_s * mean[:, 1]).max() <= a * T_s**2 + 4 * eps + v * late * T_s
    )


@pytest.mark.parametrize(
    ("name", "values", "axis"),
    [
        ("raster", {"part": "line"}, [1, 2]),
        ("raster", {"part": "frame", "lines": 4}, [1, 2]),
        ("spiral", {"part": "x"}, [1, 2]),
        ("spiral", {"part": "x", "velocity": "linear", "turns": 40}, [1]),
        ("lissajous", {"part": "x"}, [1, 2]),
    ],
)
def test_bounds_are_met_nearly(name, values, axis):
    one = signal(name, values)
    begin, length = period(one)
    W = np.abs(rows(one, 0, round((begin + length) / T_S))).max(axis=0)
    found = one.model.bounds(one.params)
    for i in axis:
        assert 0.8 * found[i - 1] < W[i] <= found[i - 1] * (1.0 + 1e-9)


# limits

PACES = [
    ("raster", {"part": "line"}, "line_rate_hz", -1),
    ("raster", {"part": "frame"}, "line_rate_hz", -1),
    ("spiral", {}, "frame_time_s", 1),
    ("lissajous", {}, "frame_time_s", 1),
]
LIMITS = {
    "velocity_max": 20.0, "acceleration_max": 300.0, "jerk_max": 2e4,
    "slew_rate": 50.0, "current_max": 5e-5,
}  # fmt: skip


@pytest.mark.parametrize("limit", LIMITS)
@pytest.mark.parametrize(("name", "values", "pace", "side"), PACES)
def test_a_scan_beyond_the_stage_names_the_nearest_value_that_works(
    name, values, pace, side, limit
):
    value = getattr(build(MODELS[name].Params, values), pace)
    fast = {**values, f"shaper.{limit}": LIMITS[limit], pace: value * 10.0**-side}
    with pytest.raises(ParameterError) as refused:
        signal(name, fast)
    text = str(refused.value)
    assert text.startswith(f"{pace} = {fast[pace]:g}: beyond the stage: its ")
    assert f"shaper.{limit}" in text
    words = text.rsplit("; give it at ", 1)[1].split()
    assert words[0] == ("least" if side > 0 else "most")
    nearest = float(words[1])
    assert signal(name, {**fast, pace: nearest})
    with pytest.raises(ParameterError, match="beyond the stage"):
        signal(name, {**fast, pace: nearest * (1.0 - side * 0.003)})


def test_a_limit_holds_for_w_whatever_the_shaper():
    limits = {"shaper.velocity_max": 300.0, "shaper.acceleration_max": 1e5, "shaper.jerk_max": 5e7}
    with pytest.raises(ParameterError) as refused:
        signal("raster", {"line_rate_hz": 100.0, **limits})
    rate = float(str(refused.value).rsplit("at most ", 1)[1].split()[0])
    one = signal("raster", {"line_rate_hz": rate, **limits}, 1e-5)
    W = rows(one, 0, round(2.2 / rate / 1e-5)) * 1e6
    assert np.abs(W[:, 1]).max() <= 300.0
    assert np.abs(W[:, 2]).max() <= 1e5
    assert np.abs(np.diff(W[:, 2]) / 1e-5).max() <= 5e7 * 1.000001


@pytest.mark.parametrize(
    ("name", "values", "text"),
    [
        ("raster", {"line_rate_hz": 1000.0, "pixels": 1},
         "line_rate_hz = 1000: its shortest motion takes 0.0001 s, less than 4 samples of "
         "5e-05 s; give it at most 500 Hz"),
        ("raster", {"line_rate_hz": 100.0, "pixels": 100},
         "pixels = 100: a pixel of 4e-05 s is shorter than a sample of 5e-05 s; give at most 80, "
         "or a lower line_rate_hz"),
        ("spiral", {"frame_time_s": 0.001}, "frame_time_s = 0.001: its shortest motion"),
        ("spiral", {"turns": 4, "inner_turns": 4},
         "inner_turns = 4: must be less than turns = 4; give at most 3"),
        ("lissajous", {"frame_time_s": 0.001}, "frame_time_s = 0.001: its shortest motion"),
        ("lissajous", {"width_um": 9000.0, "height_um": 9000.0, "resolution_um": 1e-4},
         "resolution_um = 0.0001: asks for"),
        ("points", {}, "path = '': give a CSV file"),
    ],
)  # fmt: skip
def test_what_no_stage_can_do_is_refused_in_one_line(name, values, text):
    with pytest.raises(ParameterError) as refused:
        signal(name, values)
    assert str(refused.value).startswith(text)
    assert "\n" not in str(refused.value)


# paths


def test_a_line_has_its_width_at_constant_velocity():
    one = signal("raster", {"width_um": 10.0, "line_rate_hz": 20.0, "offset_um": 6.0})
    W = rows(one, 1000, 2001)  # the first line: 1000 samples, 400 each way of constant velocity
    assert W[0, 0] == pytest.approx(1e-6, abs=1e-15)
    assert W[400, 0] == pytest.approx(11e-6, abs=1e-15)
    np.testing.assert_allclose(W[:400, 1], 10e-6 / (400 * T_S), rtol=1e-12)
    np.testing.assert_allclose(W[500:900, 1], -10e-6 / (400 * T_S), rtol=1e-12)
    assert np.ptp(W[:400, 2]) == 0.0
    assert W[:, 0].max() == W[450, 0]  # the apex of the turn


def test_a_frame_goes_from_line_to_line_and_flies_back():
    values = {"part": "frame", "height_um": 6.0, "offset_um": 5.0, "lines": 4, "line_rate_hz": 10.0}
    one = signal("raster", {**values, "flyback_lines": 2})
    for frame in (0, 3):
        at = [one.at(2000 * (1 + 6 * frame + i)).w * 1e6 for i in range(7)]
        assert at[:4] == pytest.approx([2.0, 4.0, 6.0, 8.0])
        assert at[6] == pytest.approx(2.0)
    rest = rows(one, 2000, 2000 + 1800)
    assert np.ptp(rest[:, 0]) == 0.0
    one = signal("raster", {**values, "motion": "continuous"})
    np.testing.assert_allclose(rows(one, 2000, 9000)[:, 1], 15e-6, rtol=1e-12)


def spiral(velocity, **values):
    both = [
        rows(signal("spiral", {"part": part, "offset_um": 0.0, "velocity": velocity, **values}),
             0, 40_000)
        for part in ("x", "y")
    ]  # fmt: skip
    return both[0], both[1]


def test_a_spiral_of_constant_linear_velocity_has_it():
    x, y = spiral("linear", turns=20)
    r, speed = np.hypot(x[:, 0], y[:, 0]), np.hypot(x[:, 1], y[:, 1])
    pitch = 0.2e-6
    scanned = slice(np.argmax(r > 1.01 * pitch), np.argmax(r > 0.999 * 4e-6))
    np.testing.assert_allclose(speed[scanned], speed[scanned][0], rtol=1e-9)
    b = pitch / (2 * math.pi)
    length, _ = quad(lambda th: b * math.hypot(1.0, th), 2 * math.pi * 2, 2 * math.pi * 19)
    walked = T_S * (np.argmax(r > 19 * pitch) - np.argmax(r > 2 * pitch)) * speed[scanned][0]
    assert walked == pytest.approx(length, rel=1e-4)


def test_a_spiral_of_constant_angular_velocity_has_it():
    x, y = spiral("angular")
    angle = np.unwrap(np.arctan2(y[1:, 0], x[1:, 0]))
    rate = np.diff(angle) / T_S
    assert rate[10_000:30_000] == pytest.approx(rate[20_000], rel=1e-9)


@pytest.mark.parametrize("velocity", ["angular", "linear"])
def test_turns_are_evenly_apart_and_the_way_back_is_smooth(velocity):
    x, y = spiral(velocity, turns=10)
    crossing = np.flatnonzero((y[:-1, 0] < 0.0) & (y[1:, 0] >= 0.0) & (x[:-1, 0] > 0.0))
    share = y[crossing, 0] / (y[crossing, 0] - y[crossing + 1, 0])
    r = x[crossing, 0] + share * (x[crossing + 1, 0] - x[crossing, 0])
    assert r[:10] == pytest.approx(0.4e-6 * np.arange(1, 11), abs=1e-11)
    assert np.hypot(x[-1, 0], y[-1, 0]) < 1e-9
    assert np.hypot(x[:, 0], y[:, 0]).max() < 4.0e-6 * 1.1


def test_a_lissajous_figure_is_as_fine_as_asked_for_and_no_finer():
    values = {"width_um": 8.0, "height_um": 4.0, "resolution_um": 0.4, "offset_um": 0.0}
    T_s = 2.0 / 80_000
    xy = np.column_stack(
        [rows(signal("lissajous", {**values, "part": p}, T_s), 8_000, 88_000)[:, 0]
         for p in ("x", "y")]
    )  # fmt: skip
    rng = np.random.default_rng(0)
    places = rng.uniform(-0.4, 0.4, (5_000, 2)) * 1e-6
    away, _ = cKDTree(xy).query(places)
    widest = 2.0 * away.max()  # twice the distance from the middle between two lines
    assert 0.85 * 0.4e-6 < widest < 1.02 * 0.4e-6
    away, _ = cKDTree(xy).query(rng.uniform(-1, 1, (5_000, 2)) * (3.9e-6, 1.9e-6))
    assert 2.0 * away.max() < 1.02 * 0.4e-6
    n_x, n_y = MODELS["lissajous"].periods(build(MODELS["lissajous"].Params, values))
    assert math.gcd(n_x, n_y) == 1
    np.testing.assert_allclose(xy[0], xy[-1], atol=1e-8)


# events


def test_events_of_a_raster_are_where_w_is():
    values = {"width_um": 8.0, "lines": 3, "pixels": 16, "flyback_lines": 2, "line_rate_hz": 7.0}
    line, frame = (signal("raster", {**values, "part": part}) for part in ("line", "frame"))
    last = round(13 / 7.0 / T_S)
    found = line.model.events(line.params, T_S, 0, last)
    assert (found == frame.model.events(frame.params, T_S, 0, last)).all()
    assert (np.diff(found["k"]) >= 0).all()
    frames, lines, pixels = (found[found["kind"] == kind] for kind in (FRAME, LINE, PIXEL))
    assert len(frames) == 3
    assert len(lines) == 2 * 3 * 2 + 2 * 2
    assert len(pixels) == 16 * len(lines) - 0
    step = line.model.bounds(line.params).velocity * T_S
    for event in lines:
        side = 1.0 if event["direction"] < 0 else -1.0
        w = line.at(int(event["k"])).w - 5e-6
        assert -1e-12 <= -side * (w - side * 4e-6) <= step + 1e-12
        level = 4e-6 * (event["line"] - 1)
        assert frame.at(int(event["k"])).w - 5e-6 == pytest.approx(level, abs=1e-12)
    for event in pixels[::5]:
        edge = (event["pixel"] + (event["direction"] < 0)) * 0.5e-6 - 4e-6
        w = line.at(int(event["k"])).w - 5e-6
        assert -1e-12 <= event["direction"] * (w - edge) <= step + 1e-12


@pytest.mark.parametrize(("name", "values"), [s for s in SCANS if s[0] != "points"])
def test_events_of_two_stretches_are_those_of_both(name, values):
    one = signal(name, values)
    whole = one.model.events(one.params, T_S, 0, 50_000)
    assert len(whole)
    for cut in (0, 2000, 31_234, int(whole["k"][-1])):
        parts = [one.model.events(one.params, T_S, *ends) for ends in ((0, cut), (cut, 50_000))]
        assert (np.concatenate(parts) == whole).all()


def test_lines_of_a_spiral_are_its_turns():
    one = signal("spiral", {"part": "x", "velocity": "linear", "offset_um": 0.0, "turns": 12})
    found = one.model.events(one.params, T_S, 0, 40_000)
    lines = found[found["kind"] == LINE]
    assert lines["line"].tolist() == list(range(1, 12))
    w = np.array([one.at(int(k)).w for k in lines["k"]])
    assert w == pytest.approx(4e-6 / 12 * lines["line"], abs=2e-9)


# points


def test_points_are_reached_together_and_held(listed):
    limits = {"shaper.velocity_max": 100.0, "shaper.acceleration_max": 1e4}
    x, y = (signal("points", {"path": listed, "part": part, **limits}) for part in "xy")
    assert points.scan(x.params) == points.scan(y.params) | {"path": listed}
    found = points.events(x.params, T_S, 0, 5000)
    reached = found[(found["kind"] == POINT) & (found["frame"] == 0)]["k"]
    for k, at, dwell in zip(reached, [(1, 2), (4, 2.5), (4, 0)], (200, 400, 0), strict=True):
        for i in (0, dwell - 1) if dwell else (0,):
            w = [one.at(int(k) + i).w * 1e6 for one in (x, y)]
            assert w == pytest.approx(at, abs=1e-4)
    early = rows(x, 200, int(reached[1])), rows(y, 200, int(reached[1]))
    np.testing.assert_allclose(  # a straight line
        (early[0][:, 0] - 1e-6) / 3e-6, (early[1][:, 0] - 2e-6) / 0.5e-6, atol=1e-9
    )
    assert np.abs(early[0][:, 1]).max() <= 100e-6 * 1.000001
    assert np.abs(early[0][:, 2]).max() <= 1e4 * 1e-6 * 1.000001


def test_points_that_do_not_repeat_stay_at_the_last(listed):
    one = signal("points", {"path": listed, "part": "y", "repeat": False})
    assert one.at(10**6) == (0.0, 0.0, 0.0)
    assert one.model.segments(one.params) == ()


def test_a_list_reads_the_same_from_its_text(listed, tmp_path):
    again = tmp_path / "again.csv"
    again.write_text(points.text({"path": listed}))
    one, two = (signal("points", {"path": str(p), "part": "y"}) for p in (listed, again))
    assert (rows(one, 0, 3000) == rows(two, 0, 3000)).all()


@pytest.mark.parametrize(
    ("text", "part", "error"),
    [
        ("", "x", "is empty; its first line names the columns"),
        ("1,2,3\n", "x", "'1' is no name of a column; the first line is like "),
        ("x,dwell\n", "x", "has no point; give one a line, below the names"),
        ("x,y\n1,2\n", "x", "has the columns x, y; give one of positions for each axis, and dwell"),
        ("x,x,dwell\n1,2,3\n", "x", "column x is there twice"),
        ("x [V],dwell\n1,2\n", "x", "column x has unit 'V'; give m, mm, um or nm"),
        ("x,dwell [h]\n1,2\n", "x", "column dwell has unit 'h'; give s, ms or us"),
        ("x,dwell\n1\n", "x", "line 2 has 1 values, but there are 2 columns"),
        ("x,dwell\n1,nan\n", "x", "line 2: dwell = 'nan': give a finite number"),
        ("x,dwell\n\n1,0.1\n2,-1\n", "x", "line 4 has a dwell below 0 s"),
        ("x,dwell\n1,0\n", "x", "its points take 0 s, less than a sample"),
        ("x1,dwell\n1,1\n", "x2", "part = 'x2': no column of path = "),
    ],
)
def test_a_list_that_cannot_be_read_is_refused_in_one_line(text, part, error, tmp_path):
    path = tmp_path / "points.csv"
    path.write_text(text)
    with pytest.raises(ParameterError) as refused:
        signal("points", {"path": str(path), "part": part})
    assert error in str(refused.value)
    assert str(path) in str(refused.value)


def test_what_axes_share_leaves_out_what_is_their_own():
    both = [build(MODELS["raster"].Params, {"part": part, "offset_um": offset})
            for part, offset in (("line", 1.0), ("frame", 2.0))]  # fmt: skip
    one, two = (MODELS["raster"].scan(params) for params in both)
    assert one == two
    assert "lines" in one
    assert one != MODELS["raster"].scan(build(MODELS["raster"].Params, {"lines": 9}))
