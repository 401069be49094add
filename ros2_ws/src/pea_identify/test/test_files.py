import h5py
import numpy as np
import pytest
from nptdms import ChannelObject, TdmsWriter
from scipy.io import savemat

from pea_core.params import ParameterError
from pea_identify.files import Asked, read

N, RATE = 2000, 1000.0
T = np.arange(N) / RATE
U = 20.0 + 15.0 * np.sin(2 * np.pi * 2.0 * T)
Y = 0.14 * U


def csv(path, head="t [s],u [V],y [um]", t=T, u=U, y=Y, separator=","):
    rows = [separator.join(f"{x:.10g}" for x in row) for row in zip(t, u, y, strict=True)]
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


def npz(path, **more):
    np.savez(path, u=U, y=Y, **more)
    return path


def mat5(path):
    savemat(path, {"data": {"u": U, "y": Y}, "fs": RATE})
    return path


def mat73(path):
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in (("u", U), ("y", Y)):
            item = file.create_dataset(name, data=values[None])
            item.attrs["MATLAB_class"] = np.bytes_("double")
        file["fs"] = RATE
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(128, b" "))
    return path


def hdf5(path):
    with h5py.File(path, "w") as file:
        for name, values, unit in (("run/u", U, "V"), ("run/y", Y, "um")):
            file.create_dataset(name, data=values).attrs["unit"] = unit
        file.attrs["fs"] = RATE
    return path


def tdms(path):
    about = {"wf_increment": 1.0 / RATE}
    channels = [
        ChannelObject("run", name, values, {**about, "unit_string": unit})
        for name, values, unit in (("u", U, "V"), ("y", Y, "um"))
    ]
    with TdmsWriter(path) as file:
        file.write_segment(channels)
    return path


UNITS = Asked(u=":V", y=":um")
FORMS = {
    "csv": (lambda d: csv(d / "a.csv"), Asked()),
    "semicolons": (
        lambda d: csv(d / "a.csv", "time / ms;voltage (V);y_nm", T * 1e3, U, Y * 1e3, ";"),
        Asked(),
    ),
    "npz": (lambda d: npz(d / "a.npz", fs=RATE), UNITS),
    "mat v5": (lambda d: mat5(d / "a.mat"), UNITS),
    "mat v7.3": (lambda d: mat73(d / "a.mat"), UNITS),
    "hdf5": (lambda d: hdf5(d / "a.h5"), Asked()),
    "tdms": (lambda d: tdms(d / "a.tdms"), Asked()),
    "rate asked": (lambda d: npz(d / "a.npz"), UNITS._replace(rate=RATE)),
}


@pytest.mark.parametrize("form", FORMS)
def test_each_form_gives_the_same_record(form, tmp_path):
    make, asked = FORMS[form]
    found = read(make(tmp_path), asked)
    (made,) = found.records
    np.testing.assert_allclose(made.u[:, 0], U, rtol=1e-8)
    np.testing.assert_allclose(made.y[:, 0], Y * 1e-6, rtol=1e-8)
    assert made.T_s == pytest.approx(1.0 / RATE)
    assert "1000 Hz" in found.understood


def test_voltage_of_the_interval_before_is_moved_to_its_sample(tmp_path):
    (made,) = read(csv(tmp_path / "a.csv", "t [s],u_applied [V],y [um]")).records
    np.testing.assert_allclose(made.u[:, 0], U[1:], rtol=1e-8)
    np.testing.assert_allclose(made.y[:, 0], Y[:-1] * 1e-6, rtol=1e-8)


uneven = T.copy()
uneven[900:] += 0.0007
broken = U.copy()
broken[5] = np.nan

BAD = {
    "no unit": (lambda d: csv(d / "a.csv", "t [s],u,y [um]"), Asked(), "unit of u"),
    "no time unit": (lambda d: csv(d / "a.csv", "t,u [V],y [um]"), Asked(), "unit of t"),
    "wrong unit": (lambda d: csv(d / "a.csv", "t [s],u [kg],y [um]"), Asked(), "'kg'"),
    "no column": (lambda d: csv(d / "a.csv", "t [s],a [V],b [um]"), Asked(), "which column is u"),
    "asked column": (lambda d: csv(d / "a.csv"), Asked(u="v:V"), "no column 'v'"),
    "no rate": (lambda d: npz(d / "a.npz"), UNITS, "--rate"),
    "uneven": (lambda d: csv(d / "a.csv", t=uneven), Asked(), "unevenly"),
    "falling": (lambda d: csv(d / "a.csv", t=T[::-1]), Asked(), "does not rise"),
    "NaN": (lambda d: csv(d / "a.csv", u=broken), Asked(), "not finite"),
    "no file": (lambda d: d / "b.csv", Asked(), "no such file"),
    "kind of file": (lambda d: csv(d / "a.doc"), Asked(), "unknown kind of file"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_not_said_is_asked_for(case, tmp_path):
    make, asked, words = BAD[case]
    with pytest.raises(ParameterError, match=words) as error:
        read(make(tmp_path), asked)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["a.mat", "a.h5", "a.npz", "a.csv"])
def test_a_damaged_file_is_one_line(name, tmp_path):
    path = tmp_path / name
    path.write_bytes(b"\x89nothing of that kind\n" * 40)
    with pytest.raises(ParameterError, match="cannot be read") as error:
        read(path)
    assert "\n" not in str(error.value)


def test_a_row_with_a_hole_is_named(tmp_path):
    path = csv(tmp_path / "a.csv")
    lines = path.read_text().splitlines()
    lines[7] = "0.006,,3"
    path.write_text("\n".join(lines))
    with pytest.raises(ParameterError, match="row 7"):
        read(path)


@pytest.mark.parametrize("ending", ["npz", "mat", "h5"])
def test_times_called_t_s_are_times_in_seconds(ending, tmp_path):
    """Names of arrays hold no brackets: t_s, u_V, y_um."""
    arrays, path = {"t_s": T, "u_V": U, "y_um": Y}, tmp_path / f"mine.{ending}"
    if ending == "npz":
        np.savez(path, **arrays)
    elif ending == "mat":
        savemat(path, arrays)
    else:
        with h5py.File(path, "w") as file:
            for name, values in arrays.items():
                file[name] = values
    found = read(path)
    assert "1000 Hz from t in s" in found.understood
    np.testing.assert_allclose(found.records[0].y[:, 0], Y * 1e-6)


@pytest.mark.parametrize(
    ("ending", "words"),
    [("mat", "no MATLAB file"), ("npz", "no plain arrays"), ("npy", "no plain arrays")],
)
def test_a_file_of_something_else_is_named_as_such(ending, words, tmp_path):
    path = tmp_path / f"mine.{ending}"
    path.write_bytes(b"\x93\x42" + bytes(range(200)) * 9)
    with pytest.raises(ParameterError, match=words):
        read(path)
