"""A library is checked, in a process of its own, before it is trusted."""

import subprocess
from pathlib import Path

import pytest

from pea_core.params import ParameterError
from pea_native import build
from pea_native.device import Native
from pea_plant import drivers
from pea_plant.drivers.driver import DriverError

T_s = 50e-6
TOY = Path(__file__).with_name("toy.c")


@pytest.fixture
def connected(plant):
    def connect(address: str, **values: object) -> Native:
        driver = drivers.make(plant(address, **values), T_s)
        driver.connect()
        return driver

    return connect


def test_a_good_one_exchanges(connected):
    driver = connected("good")
    try:
        assert driver.identity == "toy"
        assert driver.limits == (-30.0, 130.0, -5e-6, 20e-6)
        assert driver.tried is not None
        assert len(driver.tried.exchange_us) == 1000
        assert driver.exchange(5.0).u_applied == 0.0
        assert driver.read().u_applied == 5.0
        with pytest.raises(DriverError, match="must be within -20 to 110"):
            driver.exchange(140.0)
    finally:
        driver.close()


@pytest.mark.parametrize(
    ("address", "says"),
    [
        ("closed", "nobody is at home"),
        ("limits", "voltage_min = -30 must be below voltage_max = -40"),
        ("crash", r"crashed \(SIGABRT\)"),
        ("nan", "y = nan m at exchange 500"),
        ("moves", "the output moves from 0 to 0.1 V while it is held"),
        ("backwards", "counter 998 after 999: it must rise"),
        ("wide", r"u_applied = 1e\+06 V: the device's range is -30 to 130 V"),
    ],
)
def test_a_bad_one_is_refused_in_one_line(address, says, connected):
    with pytest.raises(ParameterError, match=says) as refused:
        connected(address)
    assert "\n" not in str(refused.value)


def test_one_that_hangs_is_given_up(monkeypatch, plant):
    monkeypatch.setattr("pea_native.device.CHECK", 0.5)
    driver = drivers.make(plant("hang", **{"driver.connect_s": 0.01}), T_s)
    with pytest.raises(ParameterError, match="did not come back within"):
        driver.connect()


@pytest.mark.parametrize(
    ("flag", "says"),
    [
        ("-DTOY_VERSION=7", "is of version 7 of pea_driver.h, version 1 is needed"),
        ("-DTOY_WITHOUT_EXCHANGE", "has no function pea_driver_exchange"),
    ],
)
def test_a_library_of_another_form_is_refused(tmp_path, flag, says, connected):
    made = tmp_path / "toy.so"
    command = [build.compiler(), "-shared", "-fPIC", flag, f"-I{build.NATIVE}", "-o", str(made)]
    subprocess.run([*command, str(TOY), "-lm"], check=True)
    with pytest.raises(ParameterError, match=says):
        connected("good", **{"driver.library": str(made)})


@pytest.mark.parametrize(
    ("library", "says"),
    [
        ("", "give the path"),
        ("/nowhere/x.so", "there is no such file"),
        (__file__, "cannot be loaded"),
    ],
)
def test_what_is_no_library_is_refused(library, says, connected):
    with pytest.raises(ParameterError, match=says):
        connected("good", **{"driver.library": library})


def test_c_that_does_not_compile_is_refused(tmp_path, connected):
    bad = Path(tmp_path, "bad.c")
    bad.write_text("int f(void) { return nothing; }\n")
    with pytest.raises(ParameterError, match="refuses it") as refused:
        connected("good", **{"driver.library": str(bad)})
    assert "\n" not in str(refused.value)


def test_no_compiler_is_said(monkeypatch, tmp_path, connected):
    monkeypatch.setenv("CC", "no-such-compiler")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(ParameterError, match="a C compiler is needed"):
        connected("good")


COMEDI = Path(__file__).with_name("comedi")
"""Comedi's interface and a card behind it, for a machine without libcomedi."""


def test_every_example_compiles_without_a_warning(tmp_path):
    flags = [*build.FLAGS, "-Wpedantic", "-Werror", f"-I{build.NATIVE}", f"-I{build.BOARD}", "-c"]
    if not Path("/usr/include/comedilib.h").exists():
        flags.append(f"-I{COMEDI}")
    for source in sorted(build.EXAMPLES.glob("*/*.c")):
        out = str(tmp_path / f"{source.stem}.o")
        subprocess.run([build.compiler(), *flags, str(source), "-o", out], check=True)
