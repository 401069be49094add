import dataclasses
import math
import os
import socket
import struct

import numpy as np
import pytest
from pymodbus.client import ModbusTcpClient

from pea_core.params import ParameterError, build
from pea_plant import drivers
from pea_plant.drivers.driver import DriverError
from pea_plant.drivers.modbus_daq import emulator
from pea_plant.plant import Params

PATIENT = 20.0
"""Time-out (s) where none is to be tested: the machine may be busy."""

FINE = emulator.Params(latency_s=0.0, dac_bits=0, ain_bits=0)
RIG = {
    "driver__calibration__amplifier": (0.75, 0.0375),  # 0 V at -20 V, 4.875 V at 110 V
    "driver__calibration__sensor": (1.0, 2.0),  # 1 um at 0 V
}


def plant(address="tcp://127.0.0.1:502", **values):
    dotted = {name.replace("__", "."): value for name, value in {**RIG, **values}.items()}
    base = {"driver.type": "modbus_daq", "driver.address": address, "driver.timeout_s": PATIENT}
    return build(Params, {**base, **dotted})


def driver_of(device, **values):
    return drivers.make(plant(device.address, **values), 2e-3)


@pytest.fixture
def device():
    with emulator.make(plant(), FINE) as emulated:
        yield emulated


@pytest.fixture
def driver(device):
    connected = driver_of(device)
    connected.connect()
    yield connected
    connected.close()


def cycles(driver):
    for _ in range(1000):
        driver.exchange(10.0)


def untouched(device):
    return device.told()["last_voltage_V"] is None


def test_connecting_moves_nothing_and_tells_the_limits(device, driver):
    assert driver.identity == "LabJack T7, serial number 470012345, firmware 1.0307"
    assert driver.limits == pytest.approx((-20.0, 340.0 / 3.0, -19e-6, 21e-6))
    assert driver.read().u_applied == pytest.approx(0.0, abs=1e-5)
    assert untouched(device)


def test_a_cycle_writes_and_tells_what_was_held_until_then(device, driver):
    assert driver.exchange(40.0).u_applied == pytest.approx(0.0, abs=1e-5)
    measured = driver.exchange(50.0)
    assert measured.u_applied == pytest.approx(40.0)
    assert math.isnan(measured.y_dot)
    assert device.stage.u == pytest.approx(50.0, abs=1e-5)
    driver.write(60.0)
    assert driver.read().u_applied == pytest.approx(60.0)
    driver.check()


def test_a_slow_ramp_is_tracked(device, driver):
    u = np.linspace(0.0, 80.0, 41)
    y = np.array([driver.exchange(v).y for v in u])
    driver.check()
    told = device.told()
    assert told["max_voltage_V"]["value"] == pytest.approx(80.0, abs=1e-4)
    assert told["max_step_V"]["value"] == pytest.approx(2.0, abs=1e-4)
    assert told["counts"]["commands"] == len(u)
    assert np.all(np.diff(y) > -0.2e-6)
    come_to_rest = pytest.approx(0.142e-6 * 80.0, rel=0.1)
    assert any(driver.exchange(80.0).y == come_to_rest for _ in range(1000))


def test_converters_have_steps():
    params = dataclasses.replace(FINE, dac_bits=12, ain_bits=16)
    with emulator.make(plant(), params) as device:
        driver = driver_of(device)
        driver.connect()
        driver.exchange(50.01)
        step = 5.0 / 4096 / 0.0375
        assert abs(device.stage.u - 50.01) <= step / 2
        assert (device.stage.u + 20.0) / step == pytest.approx(
            round((device.stage.u + 20.0) / step)
        )
        code = (driver.read().y * 1e6 - 1.0) / 2.0 / (20.0 / 65536)
        assert code == pytest.approx(round(code), abs=1e-3)
        driver.close()


def test_a_plain_modbus_client_sees_the_same_registers(device, driver):
    driver.exchange(50.0)
    host, _, port = device.address.removeprefix("tcp://").partition(":")
    client = ModbusTcpClient(host, port=int(port), timeout=PATIENT)
    read = client.read_holding_registers(1000, count=2, device_id=1).registers
    assert struct.unpack(">f", struct.pack(">2H", *read)) == pytest.approx((0.75 + 0.0375 * 50.0,))
    assert client.read_input_registers(60000, count=2, device_id=1).registers == [0x40E0, 0]
    client.write_registers(1000, [0x4000, 0], device_id=1)  # 2 V
    assert device.stage.u == pytest.approx((2.0 - 0.75) / 0.0375)
    assert client.read_holding_registers(1001, count=2, device_id=1).exception_code == 2
    client.close()
    with pytest.raises(DriverError, match="is somebody else connected"):
        driver.check()


@pytest.mark.parametrize(
    ("of_device", "of_rig", "says"),
    [
        ({"product": 4.0}, {}, r"driver.model = 'T7': at tcp.* is LabJack T4"),
        ({"product": 9.0}, {}, r"driver.model = 'T7': .*product 9"),
        ({}, {"driver__ain": 14}, r"driver.ain = 14: not an input .*error 2 \(illegal data addr"),
        ({}, {"driver__ain_range": 1.0}, r"driver.ain_range = 1: the input is set to \+-10 V"),
        ({}, {"driver__dac_max": 4.0}, r"^voltage_max = 110: must lie within -20 to 86.66\d* V"),
        ({}, {"voltage_min": -30.0}, r"^voltage_min = -30: must lie within -20 to 113"),
    ],
)
def test_what_does_not_fit_is_refused_and_nothing_moves(of_device, of_rig, says):
    with emulator.make(plant(), dataclasses.replace(FINE, **of_device)) as device:
        driver = driver_of(device, **of_rig)
        with pytest.raises(ParameterError, match=says) as refusal:
            driver.connect()
        assert "\n" not in str(refusal.value)
        assert untouched(device)
        assert driver.fileno() == -1


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"driver__calibration__amplifier": (0.0, 1.0, -0.01)}, "calibration.amplifier = .*rise"),
        ({"driver__calibration__sensor": (0.0, 1.0, -0.1)}, "calibration.sensor = .*rise or fall"),
        ({"driver__dac_min": 5.0}, r"dac_min = 5: must be below dac_max"),
        ({"address": "serial:/dev/ttyUSB0"}, r"address = .*Modbus TCP needs tcp"),
        ({"driver__model": "T9"}, r"model = 'T9'"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_opened(values, says):
    with pytest.raises(ParameterError, match="driver." + says):
        drivers.make(plant(**values), 2e-3)


def test_nobody_there_is_bad_input():
    with socket.socket() as unheard:
        unheard.bind(("127.0.0.1", 0))
        driver = drivers.make(plant(f"tcp://127.0.0.1:{unheard.getsockname()[1]}"), 2e-3)
        with pytest.raises(ParameterError, match=r"driver.address = .*is the device on"):
            driver.connect()


def test_something_else_there_is_bad_input():
    from pea_plant.drivers.nv200 import emulator as nv200

    other = build(Params, {"driver.type": "nv200"})
    with nv200.make(other, nv200.Params(latency_s=0.0, baud=0.0)) as device:
        driver = driver_of(device, driver__timeout_s=0.3)
        with pytest.raises(ParameterError, match=r"driver.address = .*no LabJack answers"):
            driver.connect()
        assert untouched(device)


@pytest.mark.parametrize("u", [math.nan, math.inf, -math.inf, 1e9, -20.001, 110.001])
def test_no_voltage_outside_the_range_is_ever_sent(device, driver, u):
    driver.exchange(10.0)
    for act in (driver.exchange, driver.write, driver.last_resort):
        with pytest.raises(DriverError, match="must be within -20 to 110 V"):
            act(u)
    driver.read()
    assert device.stage.u == pytest.approx(10.0, abs=1e-5)


@pytest.mark.parametrize(
    ("code", "name"), [(3, "illegal data value"), (6, "server device busy"), (77, "unknown")]
)
def test_an_error_of_the_device_has_its_name(device, driver, code, name):
    driver.exchange(10.0)
    device.inject(f"error={code}")
    with pytest.raises(DriverError, match=rf"error {code} \({name}\) on register 0, 1000"):
        driver.exchange(20.0)
    assert device.stage.u == pytest.approx(10.0, abs=1e-5)
    assert driver.read().u_applied == pytest.approx(10.0, abs=1e-5)  # read back: not taken


@pytest.mark.parametrize("name", ["garbage", "truncate"])
def test_after_a_bad_answer_the_driver_is_in_step_again(device, name):
    driver = driver_of(device, driver__timeout_s=0.5)
    driver.connect()
    device.inject(name)
    with pytest.raises(DriverError):
        driver.exchange(10.0)
    driver.check()
    for u in (20.0, 30.0):
        driver.exchange(u)
    device.inject("stuck")
    measured = driver.read()
    assert measured.y == pytest.approx(device.stage.reading(), abs=1e-9)
    assert measured.u_applied == pytest.approx(30.0)
    driver.close()


def test_a_late_answer_is_not_taken_for_the_next(device):
    driver = driver_of(device, driver__timeout_s=0.3)
    driver.connect()
    device.inject("delay=0.5")
    with pytest.raises(DriverError, match=r"no answer within 0.3 s"):
        driver.exchange(10.0)
    device.clear()
    device.inject("jump=3")
    for _ in range(100):  # until the device has caught up
        try:
            assert driver.exchange(10.0).y > 2.9e-6
            break
        except DriverError:
            continue
    else:
        pytest.fail("never in step again")
    driver.close()


@pytest.mark.parametrize("name", ["drop", "pull"])
def test_a_lost_connection_is_a_failure_with_a_reason(device, name):
    driver = driver_of(device, driver__timeout_s=0.3)
    driver.connect()
    device.inject(name)
    with pytest.raises(DriverError, match=r"^tcp://127.0.0.1:\d+: .*check"):
        cycles(driver)
    with pytest.raises(DriverError):
        driver.check()
    driver.close()


def test_a_stuck_and_a_saturated_device_tell_no_errors(device, driver):
    driver.exchange(10.0)
    device.inject("stuck")
    device.inject("saturate=30")
    assert len({driver.exchange(u).y for u in np.linspace(20.0, 60.0, 50)}) == 1
    driver.check()
    assert device.told()["max_voltage_V"]["value"] == 30.0


def test_the_last_resort_is_one_frame(device, driver):
    driver.exchange(80.0)
    os.write(driver.fileno(), driver.last_resort(0.0))
    driver.read()
    assert device.stage.u == pytest.approx(0.0, abs=1e-5)


def test_a_pty_is_refused():
    with pytest.raises(ParameterError, match="give a port, not a pty"):
        emulator.make(plant(), FINE, port=None)
