import struct

import pytest
from pymodbus.client import ModbusTcpClient

from pea_core.params import ParameterError
from pea_plant.drivers.driver import DriverError

PATIENCE = 20.0


@pytest.fixture
def kind():
    return "modbus_daq"


def test_it_reads_identity_and_limits(driver):
    assert driver.identity == "LabJack T7, serial number 470012345, firmware 1.0307"
    assert driver.limits == pytest.approx((-20.0, 340.0 / 3.0, -19e-6, 21e-6))


def test_converters_have_steps(bench):
    with bench.emulated(dac_bits=12, ain_bits=16) as device:
        driver = bench.driver(device)
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


def test_no_step_of_the_output_leaves_the_range(bench):
    with bench.emulated(dac_bits=12) as device:
        driver = bench.driver(device)
        driver.connect()
        for u in (-20.0, 110.0):
            driver.exchange(u)
            assert device.stage.u == pytest.approx(u, abs=0.05)
            assert -20.0 <= device.stage.u <= 110.0
        driver.close()


def test_a_plain_modbus_client_sees_the_same_registers(device, driver):
    driver.exchange(50.0)
    host, _, port = device.address.removeprefix("tcp://").partition(":")
    client = ModbusTcpClient(host, port=int(port), timeout=PATIENCE)
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
def test_what_does_not_fit_is_refused_and_nothing_moves(bench, of_device, of_rig, says):
    with bench.emulated(**of_device) as device:
        bench.refuses(device, says, **of_rig)


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
def test_what_cannot_be_is_refused_before_anything_is_opened(bench, values, says):
    with pytest.raises(ParameterError, match="driver." + says):
        bench.make(**values)


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


def test_a_pty_is_refused(bench):
    with pytest.raises(ParameterError, match="give a port, not a pty"):
        bench.emulated(port=None)
