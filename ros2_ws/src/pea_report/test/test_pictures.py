"""Pictures: maps of known errors, files that others read, bad input."""

import numpy as np
import pytest
from PIL import Image

from pea_core.block import Signal
from pea_core.params import ParameterError, build
from pea_core.signals import SAMPLE
from pea_reference.model import MODELS
from pea_report import pictures

T_S = 50e-6
SHARED = {"lines": 6, "pixels": 8, "flyback_lines": 1, "line_rate_hz": 25.0}
AREA = pictures.Area((5e-6, 5e-6), (8e-6, 8e-6))


def scanned(first=0, last=12_000, **values):
    """Samples of an ideal stage, their numbers, the events."""
    samples = np.zeros((last - first, 2), SAMPLE)
    for axis, part in enumerate(("line", "frame")):
        params = build(MODELS["raster"].Params, {**SHARED, **values, "part": part})
        one = Signal(MODELS["raster"], params, T_S)
        samples["w"][:, axis] = [one.at(k).w for k in range(first, last)]
    samples["y"] = samples["w"]
    return samples, np.arange(first, last), MODELS["raster"].events(params, T_S, first, last)


@pytest.fixture(scope="module")
def ideal():
    return scanned()


def test_an_ideal_stage_is_on_the_grid(ideal):
    maps = pictures.raster(*ideal, (6, 8), AREA)
    assert maps.names[:3] == ("frame 0 forward", "frame 0 backward", "frame 1 forward")
    assert maps.error.max() == 0.0
    step = 8e-6 / (0.4 / 25.0) * T_S
    centres = (np.arange(8) + 0.5) * 1e-6 + 1e-6
    for i, way in enumerate((1, -1)):
        np.testing.assert_allclose(maps.x[i] + 0.5 * way * step, centres + np.zeros((6, 1)))
        np.testing.assert_allclose(maps.y[i], (1e-6 + 1.6e-6 * np.arange(6))[:, None] + np.zeros(8))


def test_errors_of_a_direction_and_of_a_line_are_told_apart(ideal):
    samples, number, events = ideal
    samples = samples.copy()
    lines = events[events["kind"] == 1]
    for event in lines:
        stretch = slice(int(event["k"]), int(event["k"]) + 320)
        samples["y"][stretch, 0] += 1e-9 * event["line"] * event["direction"]
        samples["y"][stretch, 1] += 2e-9
    maps = pictures.raster(samples, number, events, (6, 8), AREA)
    np.testing.assert_allclose(maps.error_x[0], np.arange(6)[:, None] + np.zeros(8), atol=1e-6)
    np.testing.assert_allclose(maps.error_x[1], -np.arange(6)[:, None] + np.zeros(8), atol=1e-6)
    np.testing.assert_allclose(maps.error_y, 2.0, atol=1e-6)
    rms = np.sqrt(np.mean(np.arange(6.0) ** 2))
    assert pictures.figures(maps)["frame 0 forward"] == pytest.approx(
        {"rms_error_x_nm": rms, "rms_error_y_nm": 2.0, "rms_error_distance_nm": np.hypot(rms, 2.0),
         "max_error_nm": np.hypot(5.0, 2.0)}, rel=1e-6,
    )  # fmt: skip


def test_a_gap_and_an_incomplete_frame_leave_pixels_out(ideal):
    samples, number, events = ideal
    kept = (number < 2000) | (number >= 2600)
    maps = pictures.raster(samples[kept], number[kept], events, (6, 8), AREA)
    assert np.isnan(maps.x[0, 2]).sum() > 0
    assert np.isfinite(maps.x[0, 3]).all()
    assert maps.error[np.isfinite(maps.error)].max() == 0.0
    with pytest.raises(ParameterError, match="holds no pixel"):
        pictures.raster(samples[:500], number[:500], events[:0], (6, 8), AREA)


def test_the_picture_that_an_ideal_scan_takes_is_the_picture(ideal):
    picture = np.add.outer(np.arange(40.0), 3.0 * np.arange(60.0))  # a plane
    maps = pictures.raster(*ideal, (6, 8), AREA, picture)
    x = (maps.x - 1e-6) / 8e-6 * 60 - 0.5
    y = np.clip((maps.y - 1e-6) / 8e-6 * 40 - 0.5, 0, 39)
    np.testing.assert_allclose(maps.grey, y + 3.0 * x, atol=0.6)
    np.testing.assert_allclose(maps.grey[:, 2, 1:7], (y + 3.0 * x)[:, 2, 1:7], atol=1e-6)


def test_any_scan_is_binned_by_the_wanted_position(ideal):
    samples = ideal[0].copy()
    samples["y"][:, 0] += np.where(samples["w"][:, 1] > 5e-6, 3e-9, -1e-9)
    maps = pictures.binned(samples, 4, AREA)
    np.testing.assert_allclose(maps.error_x[0, 3], 3.0, atol=1e-6)
    np.testing.assert_allclose(maps.error_x[0, 0], -1.0, atol=1e-6)


def test_files_hold_the_maps(ideal, tmp_path):
    import h5py

    maps = pictures.raster(*ideal, (6, 8), AREA, np.eye(9))
    for name in ("a.png", "a.svg", "a.npz", "a.h5"):
        pictures.write(tmp_path / name, maps, "title")
        with pytest.raises(ParameterError, match="exists already"):
            pictures.write(tmp_path / name, maps)
    with np.load(tmp_path / "a.npz") as found:
        np.testing.assert_array_equal(found["x_um"], maps.x * 1e6)
        assert found["names"].tolist() == list(maps.names)
    with h5py.File(tmp_path / "a.h5") as found:
        np.testing.assert_array_equal(found["error_nm"], maps.error)
        np.testing.assert_array_equal(found["signal"], maps.grey)
        assert found.attrs["sides_um"] == pytest.approx([8.0, 8.0])
    with Image.open(tmp_path / "a.png") as found:
        assert found.size[0] > 1000
    assert (tmp_path / "a.svg").read_text().count("<image") >= 8  # pixels stay pixels
    with pytest.raises(ParameterError, match=r"must end in \.png, \.svg, \.npz, \.h5"):
        pictures.write(tmp_path / "a.tif", maps)


def test_a_signal_is_read_as_grey_values(tmp_path):
    Image.fromarray(np.array([[0, 255], [51, 102]], np.uint8)).save(tmp_path / "a.png")
    np.testing.assert_allclose(pictures.image(tmp_path / "a.png"), [[0.0, 1.0], [0.2, 0.4]])
    np.save(tmp_path / "a.npy", np.array([[1, 2], [3, 4]]))
    np.testing.assert_array_equal(pictures.image(tmp_path / "a.npy"), [[1, 2], [3, 4]])


@pytest.mark.parametrize("name", ["none.png", "text.png", "row.npy", "text.npy"])
def test_a_signal_that_is_no_picture_is_refused_in_one_line(name, tmp_path):
    (tmp_path / "text.png").write_text("no picture")
    (tmp_path / "text.npy").write_text("no picture")
    np.save(tmp_path / "row.npy", np.arange(3))
    with pytest.raises(ParameterError, match="--signal ") as refused:
        pictures.image(tmp_path / name)
    assert "\n" not in str(refused.value)


def test_a_point_is_reached_when_all_axes_stay_within_the_tolerance(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("x,y,dwell\n1,1,0.01\n2,1,0.01\n2,3,0.01\n")
    samples = np.zeros((1500, 2), SAMPLE)
    for axis, part in enumerate("xy"):
        params = build(MODELS["points"].Params, {"path": str(path), "part": part, "repeat": False})
        one = Signal(MODELS["points"], params, T_S)
        samples["w"][:, axis] = [one.at(k).w for k in range(1500)]
    events = MODELS["points"].events(params, T_S, 0, 1500)
    number = np.arange(1500)
    samples["y"] = samples["w"]
    k = [int(event["k"]) for event in events if event["kind"] == 3]
    samples["y"][k[1] + 30, 1] += 5e-9
    samples["y"][k[2] :, 0] += 5e-9
    found = pictures.on_target(samples, number, events, 2e-9)
    assert [(each.planned, each.reached) for each in found] == [
        (0, 0), (k[1], k[1] + 31), (k[2], None)
    ]  # fmt: skip
