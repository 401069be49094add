"""The examples at work: a card of comedi, and a controller in C on a board in C."""

import ctypes
import math
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from pea_core.params import ParameterError
from pea_native import build
from pea_plant import drivers
from pea_plant.drivers.driver import DriverError

COMEDI = Path(__file__).with_name("comedi")
OPTIONS = "amplifier=-20:13&sensor=1:2"  # 0 V at 1.54 V of the output; 1 um at 0 V of the input


@pytest.fixture(scope="module")
def card() -> str:
    """The driver of comedi with a card that needs no hardware."""
    return str(build.made([build.NATIVE / "comedi.c", COMEDI / "card.c"], "comedi_card"))


@pytest.fixture
def comedi(plant, card):
    def connected(options: str = OPTIONS, device: str = "/dev/comedi0", **values: object):
        address = f"{device}?{options}"
        driver = drivers.make(plant(address, **{"driver.library": card, **values}), 1e-3)
        driver.connect()
        return driver

    return connected


def test_a_card_of_comedi_is_read_and_written(comedi):
    driver = comedi()
    try:
        assert driver.identity == "card (test)"
        assert driver.limits == pytest.approx((-20.0, 110.0, -19e-6, 21e-6))
        assert driver.read().u_applied == -20.0  # its output stands at 0 V: the end of its range
        driver.exchange(45.0)
        y, _, held = driver.read()
        assert held == pytest.approx(45.0, abs=0.02)
        assert y == pytest.approx(1e-6 + 2e-6 * 2.5, abs=2e-9)
        for u in (110.0, -20.0):
            driver.exchange(u)
            assert driver.read().u_applied == pytest.approx(u)
    finally:
        driver.close()


def test_an_input_at_the_end_of_its_range_is_no_number(comedi, card):
    driver = comedi()
    try:
        reads = ctypes.CDLL(card)
        behind = ctypes.c_uint.in_dll(reads, "card_input")
        behind.value = 65535
        assert math.isnan(driver.read().y)
    finally:
        behind.value = 0
        driver.close()


@pytest.mark.parametrize(
    ("options", "device", "says"),
    [
        ("gain=2", "/dev/comedi0", "options are out=N"),
        ("sensor=1:0", "/dev/comedi0", "a slope of 0"),
        ("out=7", "/dev/comedi0", "no such channel"),
        (OPTIONS, "/dev/comedi7", "no such card"),
    ],
)
def test_a_card_that_cannot_be_used_is_refused(comedi, options, device, says):
    with pytest.raises((ParameterError, DriverError), match=says):
        comedi(options, device)


@pytest.fixture
def board() -> Iterator[str]:
    """Address of the board in C with its own stage, at 20 kHz."""
    program = build.made(sorted(build.BOARD.glob("*.c")), "board", shared=False)
    process = subprocess.Popen(
        [str(program), "udp://127.0.0.1:0"], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    try:
        yield f"udp://127.0.0.1:{int(process.stdout.readline().split()[1])}"
    finally:
        process.terminate()
        process.communicate()


def test_a_controller_in_c_holds_the_stage_of_a_board_in_c(board):
    sources = [build.EXAMPLES / "controller" / "controller.c", build.NATIVE / "udp.c"]
    program = build.made(sources, "controller", shared=False)
    ended = subprocess.run([str(program), board], capture_output=True, text=True, timeout=60.0)
    assert ended.returncode == 0, ended
    word, error, _, _, u, _ = ended.stdout.split()
    assert word == "error"
    assert abs(float(error)) < 50.0  # nm, of 5 um
    assert 20.0 < float(u) < 60.0
